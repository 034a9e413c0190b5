# SPDX-License-Identifier: Apache-2.0
"""Constants of the world that Panda3D draws, each with its source; lengths in m, angles in rad, colours linear RGB.

Colours are reflectances: the light that a surface returns under full daylight, as a share of what falls on it.
"""

from __future__ import annotations

import math

from ds_sim.camera.optics import KOSCHMIEDER

Linear = tuple[float, float, float]  # linear RGB, as shares of full daylight on level ground

LUMINANCE: Linear = (0.2126, 0.7152, 0.0722)  # share of each colour in luminance (ITU-R BT.709)

# Sun and sky.

LATITUDE = math.radians(46.0)  # chosen: Lugano, where the paper comes from
# Of the sun on 1 June: 23.45 degrees x sin(360 degrees x (284 + 152) / 365) (Cooper 1969).
DECLINATION = math.radians(22.0)
# 15 degrees an hour from noon; chosen: half past eight in solar time, so that the shadow of a tree is as long as the
# tree is high and reaches the road.
HOUR_ANGLE = math.radians(-52.5)
EXTINCTION = 0.21  # optical depth of a clear atmosphere (IESNA Lighting Handbook, daylight availability)
SOLAR_ILLUMINANCE = 127.5  # above the atmosphere, klx (IESNA)
# On level ground from a clear sky, klx: the first + the second x sqrt(sin(elevation)) (IESNA).
SKY_ILLUMINANCE = (0.8, 15.5)
# Colour of sunlight, of luminance 1; chosen: about 5,000 K on a scale whose white is the mixed daylight.
SUN_TINT: Linear = (1.06, 1.0, 0.86)
SKY_TINT: Linear = (0.78, 1.02, 1.44)  # colour of skylight, of luminance 1; chosen: about 10,000 K on the same scale
# Colour of the sky from `ZENITH_ELEVATION` upwards; chosen: its luminance is 0.19, what a white surface sends back of
# the sky's share of daylight.
ZENITH: Linear = (0.10, 0.21, 0.46)
# Colour of the sky at the horizon, and of haze; chosen: three times as bright as the zenith (CIE clear sky).
HORIZON: Linear = (0.46, 0.55, 0.66)
ZENITH_ELEVATION = math.radians(55.0)  # chosen
CLOUD: Linear = (0.80, 0.82, 0.85)  # chosen: fair-weather cumulus, nearly white
CLOUD_COVER = 0.35  # share of the sky; chosen: three oktas, "scattered"
# Distance at which 2% of a contrast is left (Koschmieder); chosen: the lower end of what is called clear.
VISIBILITY = 10_000.0
HAZE = KOSCHMIEDER / VISIBILITY  # extinction coefficient, 1/m

# Colour of fog, whose droplets scatter all colours alike; chosen: as bright as `HORIZON`.
FOG: Linear = (0.54, 0.54, 0.54)
FOG_TOP = 100.0  # height of the layer of fog; chosen: radiation fog is 15 to 100 m high

# Road.

LINE_WIDTH = 0.15  # of all three lines; chosen: as on country roads (RMS: 0.12 m to 0.15 m)
WHITE: Linear = (0.60, 0.60, 0.60)  # luminance factor 0.60: EN 1436 class B4, a line of some years
# Luminance factor 0.40 (EN 1436 class B3 for yellow) at chromaticity (0.475, 0.455), in EN 1436's box for yellow.
YELLOW: Linear = (0.708, 0.348, 0.007)
LINE_WEAR = 0.25  # share of a line's paint that the texture takes off at most; chosen
ASPHALT: Linear = (0.120, 0.120, 0.123)  # aged asphalt, 0.10 to 0.15 (Pomerantz et al. 2000, LBNL-43431)
VERGE_WIDTH = 1.0  # strip of gravel beside the road; chosen: the least that RAL 2012 has beside small country roads
# Dry soil with stones, 0.2 (Oke 1987, table 1.1: 0.05 wet dark to 0.40 dry sandy).
GRAVEL: Linear = (0.235, 0.205, 0.165)
# Visible part of a meadow's reflectance: about 0.1 with its peak in the green (Bowker et al. 1985, NASA RP-1139).
GRASS: Linear = (0.085, 0.135, 0.040)
# Length of straight road before the start and beyond the end; chosen: neither ends abruptly in view.
LEAD_IN, LEAD_OUT = 20.0, 60.0

# How unevenly worn paint is left on chippings, 0 (evenly) to 1.5 (none at the most worn places); chosen.
PAINT_BLOTCHES = 1.0
# Lengths and widths of repair patches, m, and the standard deviation of their direction from that of the road, rad;
# chosen: from a filled pothole to a resurfaced wheel track, sawn along the road by eye.
PATCH_LENGTHS, PATCH_WIDTHS, PATCH_TURN = (1.0, 6.0), (0.5, 3.0), 0.05
# Share of patches that are cuts across the road for pipes, and their widths, m; chosen.
CUT_SHARE, CUT_WIDTH = 0.15, (0.4, 0.9)
# Reflectance of new asphalt (American Concrete Pavement Association), and most of it over that of the road around.
NEW_ASPHALT, PATCH_CONTRAST = 0.05, 0.6

# Shadows of conditions.

# Length along the road of one shadow; chosen: the crown of a young tree, which merges with its neighbours.
SHADE_LENGTH = 3.0
SHADE_REACH = 6.0  # distance beyond the verge that shadows extend; chosen: that they seem to come from beside the road
# Displacement of a shadow's sides by the slow variation of all surfaces, m; chosen: branches of half a metre.
SHADE_FRAYING = 1.6
# The larger, the more shadows lie across the road where the sun shines along it; chosen: 42 degrees at most.
SHADE_SLANT = 0.25

# Beside the road.

CLEARANCE = 0.3  # distance that everything keeps from the verge; chosen
# Margin around the road's bounding box in which things stand; chosen: what is farther is a few pixels high.
SURROUNDINGS = 60.0
# Distance of delineators; RPS, German delineators: 50 m on straights, down to 10 m in bends; chosen: one value.
POST_SPACING = 25.0
POST_HEIGHT, POST_WIDTH = 1.0, 0.12  # height and width of a delineator (HLB: 1 m; 0.12 m)
TREE_SPACING = 7.0  # cell of the grid on which trees may stand; chosen: mature crowns nearly touch
TREE_HEIGHT = (6.0, 11.0)  # least and greatest; chosen: young to grown limes, maples and spruces
BUSH_HEIGHT = (1.0, 2.0)  # least and greatest; chosen: hedges
BUSH_SHARE, CONIFER_SHARE = 0.3, 0.15  # shares of the plants, where conifers prefer some places; chosen
# Share of the grid's cells with a plant, and how much it varies from place to place (standard deviation); chosen: an
# open country with groves.
GROVES = (0.11, 0.22)
GROVE_LIMITS = (0.03, 0.5)  # least and greatest share; chosen
# Plants farther from the centre line have fewer triangles; chosen: half a metre of them is less than three pixels.
FAR_FROM_ROAD = 28.0
# Within this distance of the centre line there are so many times more plants; chosen: trees line country roads.
ROADSIDE, ROADSIDE_SHARE = 16.0, 4.0
HOUSE_SIZE = (5.5, 4.2, 8.5)  # half the length, half the width, height; chosen: a farmhouse of two storeys
HOUSE_DISTANCE = (15.0, 40.0)  # least and greatest distance of a house's centre from the road's centre line; chosen
HOUSES = (2, 6)  # least and greatest number of houses; chosen: a scattered village
LEAVES: Linear = (0.085, 0.135, 0.035)  # reflectance of a leaf, visible: 0.05 to 0.15 (Bowker et al. 1985).
NEEDLES: Linear = (0.045, 0.085, 0.040)  # conifers are about half as bright as broad-leaved trees (Bowker et al. 1985).
BARK: Linear = (0.12, 0.095, 0.07)  # chosen: grey-brown
WALL: Linear = (0.62, 0.57, 0.48)  # chosen: light plaster, 0.5 to 0.7
ROOF: Linear = (0.30, 0.11, 0.065)  # chosen: clay tiles
POST: Linear = (0.70, 0.70, 0.70)  # chosen: white plastic

# Drawing.

SAMPLES = 4  # samples of a pixel; chosen: what llvmpipe offers
# Distance along the axis within which the road hides the ground below it, which is then not drawn; chosen: a pixel
# there is less than 0.4 m wide, and where the road fades out the verge below it is whole.
HIDING_WITHIN = 6.0
# Margin around the road's bounding box in which there are shadows; chosen: farther ones are less than a pixel high.
SHADOW_MARGIN = 25.0
SHADOW_PIXELS = 2048  # size of the map of shadows; chosen: pixels of about 0.1 m on most roads
NEAR, FAR = 0.3, 40_000.0  # nearest and farthest that is drawn; the ground ends at `GROUND_RADIUS`
GROUND_RADIUS = 20_000.0  # chosen: its border is a hundredth of a pixel below the horizon
