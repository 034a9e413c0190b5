"""What a camera is and where it sits on its vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
            angles from the optical axis, which shows as barrel distortion.
        gain: brightness factor (exposure).
        gamma: of the sensor's response; 1 is linear.
        noise: standard deviation of the sensor noise, grey levels.
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
    noise: float = 0.0
    latency: int = 0
    width: int = IMAGE_WIDTH
    height_px: int = IMAGE_HEIGHT

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Camera matrix K (3, 3) of the delivered image, px."""
        half = self.horizontal_fov / 2
        focal = (self.width / 2) / (half if self.lens == "equidistant" else math.tan(half))
        return np.array([[focal, 0, (self.width - 1) / 2], [0, focal, (self.height_px - 1) / 2], [0, 0, 1.0]])
