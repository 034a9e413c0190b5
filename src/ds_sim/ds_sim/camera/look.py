# SPDX-License-Identifier: Apache-2.0
"""Appearance of a simulator's world, within the paper's harmonised scene (section 3.1.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Colour = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colours and textures of road, lines, grass and sky; colours are RGB, 0 to 255.

    Attributes:
        asphalt: colour of the road.
        grass: colour of the plane beside it.
        edge_line: colour of the two edge lines.
        centre_line: colour of the centre line.
        sky_top: colour at the top of the image.
        horizon: colour of sky and far ground at the horizon.
        line_width: width of the lines, m (chosen per simulator, about the 0.10 to 0.15 m of road markings).
        asphalt_grain: standard deviation of the asphalt's texture, grey levels.
        grass_grain: standard deviation of the grass's texture, grey levels.
        grain_seed: seed of the textures; part of the look, the same in every run.
        relief: standard deviation of the directional shading of the grass, grey levels.
        sky_height: elevation at which the sky reaches `sky_top`, degrees.
        sun_azimuth: direction of the light, rad, counter-clockwise from +x of the road frame.
        sun_elevation: elevation of the light above the horizon, rad.
        sun_glow: brightness added to the sky at the sun, grey levels.
        hills: height of the skyline above the horizon, degrees; 0 for none. It never extends below the horizon.
        hill_colour: colour of the skyline.
        skyline: kind of skyline.
        lamps: number of lamps above the skyline.
    """

    asphalt: Colour
    grass: Colour
    edge_line: Colour = (235, 235, 235)
    centre_line: Colour = (225, 190, 40)
    sky_top: Colour = (120, 170, 230)
    horizon: Colour = (200, 215, 230)
    line_width: float = 0.15
    asphalt_grain: float = 6.0
    grass_grain: float = 14.0
    grain_seed: int = 1
    relief: float = 0.0
    sky_height: float = 40.0
    sun_azimuth: float = 0.0
    sun_elevation: float = 0.6
    sun_glow: float = 0.0
    hills: float = 0.0
    hill_colour: Colour = (110, 130, 120)
    skyline: Literal["hills", "trees", "room"] = "hills"
    lamps: int = 0
