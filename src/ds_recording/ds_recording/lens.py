# SPDX-License-Identifier: Apache-2.0
"""Lens models of OpenCV and of ROS's `sensor_msgs/CameraInfo`: slopes of rays to places in the image and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rays = NDArray[Any]
"""Of single or double precision."""
MODELS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Name in `CameraInfo` -> number of coefficients, in OpenCV's order; `equidistant` is OpenCV's fisheye."""
_WIDEST = 4.0
"""Largest tangent of the angle from the optical axis that a model is used for; chosen: 76 degrees."""


@dataclass(frozen=True)
class Lens:
    """Distortion of a lens, in units of the focal length."""

    model: str = "plumb_bob"  # one of `MODELS`
    # k1, k2, p1, p2, k3 (plumb_bob), with k4, k5, k6 (rational_polynomial), or k1 to k4 (equidistant).
    coefficients: tuple[float, ...] = (0.0,) * 5

    @property
    def _tangential(self) -> tuple[float, float]:
        return (0.0, 0.0) if self.model == "equidistant" else (self.coefficients[2], self.coefficients[3])

    def _stretch(self, square: Rays) -> Rays:
        """Distorted over undistorted distance from the axis, for the square of the latter."""
        if self.model == "equidistant":
            radius = np.maximum(np.sqrt(square), 1e-6)
            angle = np.arctan(radius)
            square = angle * angle
            k1, k2, k3, k4 = self.coefficients
            return angle / radius * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
        k1, k2, _, _, k3, *rational = self.coefficients
        stretch = 1.0 + square * (k1 + square * (k2 + square * k3))
        if any(rational):
            k4, k5, k6 = rational
            stretch = stretch / (1.0 + square * (k4 + square * (k5 + square * k6)))
        return stretch

    @cached_property
    def _radii(self) -> tuple[Array, Array]:
        """Distorted and undistorted distances from the axis, as far as the former increase."""
        radius = np.linspace(0.0, _WIDEST, 4001)
        distorted = radius * self._stretch(radius * radius)
        falling = np.flatnonzero(np.diff(distorted) <= 0.05 * (radius[1] - radius[0]))
        end = int(falling[0]) + 1 if falling.size else len(radius)
        return distorted[:end], radius[:end]

    @property
    def reach(self) -> float:
        """Largest tangent of the angle from the axis that the model covers."""
        return float(self._radii[1][-1])

    def distorted(self, right: Rays, down: Rays) -> tuple[Rays, Rays]:
        """Places of rays with these slopes."""
        square = right * right + down * down
        stretch = self._stretch(square)
        x, y = right * stretch, down * stretch
        p1, p2 = self._tangential
        if p1 or p2:
            product = 2.0 * right * down
            x += p1 * product + p2 * (square + 2.0 * right * right)
            y += p1 * (square + 2.0 * down * down) + p2 * product
        return x, y

    def slopes(self, places: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Slopes right and down of the rays through places, (n, 2), and which of them the model covers."""
        p1, p2 = self._tangential
        distorted, radius = self._radii
        slopes, plain = places.copy(), places
        for _ in range(4 if p1 or p2 else 1):
            if p1 or p2:
                x, y = slopes.T
                square = x * x + y * y
                plain = places - np.stack(
                    (2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y), axis=1
                )
            length = np.hypot(*plain.T)
            slopes = plain * (np.interp(length, distorted, radius) / np.maximum(length, 1e-12))[:, None]
        return slopes, np.hypot(*plain.T) < distorted[-1]
