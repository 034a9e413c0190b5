"""What a camera is and where it sits on its vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import pade

IMAGE_HEIGHT, IMAGE_WIDTH = 160, 320
"""Camera image in pixels (paper 3.2.2)."""


@dataclass(frozen=True, kw_only=True)
class CameraSpec:
    """A camera and where it sits on the vehicle; lengths in road metres.

    Attributes:
        horizontal_fov: angle between the left and right image borders, rad.
        height: of the optical centre above ground, m.
        forward: of the optical centre before the vehicle's centre, m.
        pitch: of the optical axis, nose down positive, rad.
        lens: `pinhole`, or `equidistant` for a wide angle: distances from the image's middle are proportional to
            angles from the optical axis (within 0.01 px, see `distortion`), which shows as barrel distortion.
        gain: brightness factor.
        gamma: of the sensor's response; 1 is linear.
        exposure: time that the shutter is open, s; what moves meanwhile is blurred.
        blur: standard deviation of the lens's point spread, px.
        noise: standard deviation of the sensor noise, grey levels.
        noise_blur: standard deviation of the filter that the noise went through (demosaicing, JPEG), px.
        noise_colour: share of the noise that is not common to the three colours, 0 grey to 1.
        latency: frames between exposure and delivery.
        width: image columns.
        height_px: image rows.
    """

    horizontal_fov: float
    height: float
    forward: float = 0.0
    pitch: float = 0.0
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
        """OpenCV's k1, k2, p1, p2, k3, k4, k5, k6 of the lens; no more than five zeros for the pinhole.

        The wide-angle lens is the rational polynomial itself, with the coefficients of the Pade approximant of
        atan(r) / r, so that `cv2.undistort` and a ROS `rational_polynomial` hold exactly. It is equidistant within
        0.01 px up to 67 degrees from the axis, the image's corner.
        """
        if self.lens == "pinhole":
            return (0.0,) * 5
        # atan(r) / r = 1 - t / 3 + t^2 / 5 - ... with t = r^2.
        above, below = pade([(-1) ** n / (2 * n + 1) for n in range(7)], 3)
        k3, k2, k1 = above.coeffs[:3]
        k6, k5, k4 = below.coeffs[:3]
        return tuple(float(k) for k in (k1, k2, 0.0, 0.0, k3, k4, k5, k6))
