# SPDX-License-Identifier: Apache-2.0
"""Properties of a camera and its mounting on the vehicle, and of the world that it sees."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

IMAGE_HEIGHT, IMAGE_WIDTH = 160, 320
"""Size of the camera image, pixels (paper 3.2.2)."""
EQUIDISTANT = (
    0.7798176789378387,
    0.10654770039859429,
    0.0,
    0.0,
    0.0012943515580691727,
    1.1129795642217255,
    0.27857066369879807,
    0.01189685406412727,
)
"""Rational polynomial closest to atan(r) / r up to 72 degrees from the axis, past the corner of 120 degrees at 2:1: k1,
k2, p1, p2, k3, k4, k5, k6, by linear least squares. Not fitted at run time: LAPACK rounds by the type of processor."""


@dataclass(frozen=True, kw_only=True)
class CameraSpec:
    """Camera and its mounting on the vehicle; lengths in road metres.

    Attributes:
        horizontal_fov: angle between the left and right image borders, rad.
        height: height of the optical centre above ground, m.
        forward: distance of the optical centre ahead of the vehicle's centre, m.
        pitch: angle of the optical axis, nose down positive, rad.
        yaw: angle of the optical axis about the vehicle's vertical axis, left positive, rad.
        lens: `pinhole`, or `equidistant` for a wide angle: distances from the image centre are proportional to angles
            from the optical axis (within 0.01 px, see `distortion`), which appears as barrel distortion.
        gain: brightness factor.
        gamma: exponent of the sensor's response; 1 is linear.
        exposure: exposure time, s; motion during it is blurred.
        blur: standard deviation of the lens's point spread function, px.
        noise: standard deviation of the sensor noise, grey levels.
        noise_blur: standard deviation of the filter applied to the noise (demosaicing, JPEG), px.
        noise_colour: share of the noise that is independent between the colours, 0 (grey) to 1.
        latency: delay between exposure and delivery, frames.
        width: image columns.
        height_px: image rows.
    """

    horizontal_fov: float
    height: float
    forward: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    lens: Literal["pinhole", "equidistant"] = "pinhole"
    gain: float = 1.0
    gamma: float = 1.0
    exposure: float = 0.0
    blur: float = 0.0
    noise: float = 0.0
    noise_blur: float = 0.0
    noise_colour: float = 1.0
    latency: int = 0
    width: int = IMAGE_WIDTH
    height_px: int = IMAGE_HEIGHT

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Camera matrix K (3, 3) of the delivered image, px."""
        half = self.horizontal_fov / 2
        focal = (self.width / 2) / (half if self.lens == "equidistant" else math.tan(half))
        return np.array([[focal, 0, (self.width - 1) / 2], [0, focal, (self.height_px - 1) / 2], [0, 0, 1.0]])

    @property
    def distortion(self) -> tuple[float, ...]:
        """OpenCV's distortion coefficients k1, k2, p1, p2, k3, k4, k5, k6; five zeros for the pinhole.

        The wide-angle lens is defined by the rational polynomial itself, so that `cv2.undistort` and a ROS
        `rational_polynomial` are exact. It is equidistant within 0.01 px up to 67 degrees from the axis, the corner of
        an image with a field of view of 120 degrees.
        """
        if self.lens == "pinhole":
            return (0.0,) * 5
        return EQUIDISTANT


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
