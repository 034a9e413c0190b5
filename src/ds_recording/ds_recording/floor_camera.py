# SPDX-License-Identifier: Apache-2.0
"""Camera of a recording above a flat floor: pixels to points of the floor and back, and its YAML file."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_yaml import BoundedYamlError, read_yaml
from ds_recording.errors import RecordingError
from ds_road.road import abbreviated

Array = NDArray[np.float64]
Rays = NDArray[Any]
"""Of single or double precision."""
_WIDEST = 4.0
"""Largest tangent of the angle from the optical axis that a lens model is used for; chosen: 76 degrees."""
_FLATTEST = 0.03
"""Least descent of a ray that is taken to the floor; chosen: beyond, the floor is farther than 30 camera heights."""
LIMITS = {
    "width_px": (16, 8192), "height_px": (16, 8192), "focal_px": (1.0, 1e5), "centre_x_px": (-1e4, 1e4),
    "centre_y_px": (-1e4, 1e4), "height_m": (1e-3, 100.0), "pitch_rad": (-0.3, 1.4), "forward_m": (-100.0, 100.0),
    "focal_std": (0.0, 1e5),
}  # fmt: skip
"""Least and largest value of each number of the file."""
MOUNTING = ("height_m", "pitch_rad")
"""What a chessboard does not tell: null in its file, then estimated from the lines."""


@dataclass(frozen=True, kw_only=True)
class FloorCamera:
    """Pinhole with OpenCV's distortion, without roll, above a flat floor.

    Attributes:
        width_px: image columns.
        height_px: image rows.
        focal_px: focal length, px, the same in both directions.
        centre_x_px: column of the optical axis; whole numbers are the centres of pixels.
        centre_y_px: row of the optical axis.
        height_m: height of the optical centre above the floor; None if unknown.
        pitch_rad: angle of the optical axis below the horizontal; None if unknown.
        forward_m: distance of the optical centre ahead of the car's centre.
        distortion: k1, k2, p1, p2, k3 of OpenCV.
        focal_std: standard deviation of the focal length, px.
    """

    width_px: int
    height_px: int
    focal_px: float
    centre_x_px: float
    centre_y_px: float
    height_m: float | None = None
    pitch_rad: float | None = None
    forward_m: float = 0.0
    distortion: tuple[float, ...] = (0.0,) * 5
    focal_std: float = 0.0

    @property
    def mounted(self) -> bool:
        """Whether height and pitch are known."""
        return self.height_m is not None and self.pitch_rad is not None

    def scaled(self, factor: float) -> FloorCamera:
        """The same camera in other units of length."""
        height = None if self.height_m is None else self.height_m * factor
        return replace(self, height_m=height, forward_m=self.forward_m * factor)

    def resized(self, columns: int, rows: int) -> FloorCamera:
        """The same camera with images of another size."""
        x, y = columns / self.width_px, rows / self.height_px
        return replace(
            self, width_px=columns, height_px=rows, focal_px=self.focal_px * x, focal_std=self.focal_std * x,
            centre_x_px=(self.centre_x_px + 0.5) * x - 0.5, centre_y_px=(self.centre_y_px + 0.5) * y - 0.5,
        )  # fmt: skip

    @property
    def horizon_row(self) -> float:
        """Row of the horizon in the middle column."""
        return self.centre_y_px - self.focal_px * math.tan(self._mount[1])

    @property
    def _mount(self) -> tuple[float, float]:
        assert self.height_m is not None and self.pitch_rad is not None
        return self.height_m, self.pitch_rad

    @cached_property
    def _radii(self) -> tuple[Array, Array]:
        """Distorted and undistorted distances from the axis, as far as the polynomial increases."""
        k1, k2, _, _, k3 = self.distortion
        radius = np.linspace(0.0, _WIDEST, 4001)
        distorted = radius * (1.0 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6)
        falling = np.flatnonzero(np.diff(distorted) <= 0.05 * (radius[1] - radius[0]))
        end = int(falling[0]) + 1 if falling.size else len(radius)
        return distorted[:end], radius[:end]

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Slopes right and down of the rays through pixels, (n, 2), and which of them the lens model covers."""
        _, _, p1, p2, _ = self.distortion
        seen = (pixels - (self.centre_x_px, self.centre_y_px)) / self.focal_px
        distorted, radius = self._radii
        found, plain = seen.copy(), seen
        for _ in range(1 if p1 == p2 == 0.0 else 4):
            if p1 or p2:
                x, y = found.T
                square = x * x + y * y
                plain = seen - np.stack(
                    (2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y), axis=1
                )
            length = np.hypot(*plain.T)
            found = plain * (np.interp(length, distorted, radius) / np.maximum(length, 1e-12))[:, None]
        return found, np.hypot(*plain.T) < distorted[-1]

    def pixels(self, right: Rays, down: Rays) -> tuple[Rays, Rays, NDArray[np.bool_]]:
        """Columns and rows of rays with these slopes, px, and which of them the lens model covers; OpenCV's formula."""
        k1, k2, p1, p2, k3 = self.distortion
        square = right * right + down * down
        stretch = 1.0 + square * (k1 + square * (k2 + square * k3))
        x, y = right * stretch, down * stretch
        if p1 or p2:
            product = 2.0 * right * down
            x += p1 * product + p2 * (square + 2.0 * right * right)
            y += p1 * (square + 2.0 * down * down) + p2 * product
        known = square < self._radii[1][-1] ** 2
        return self.centre_x_px + self.focal_px * x, self.centre_y_px + self.focal_px * y, known

    def floor(self, pixels: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Points of the floor, ahead and left of the car's centre, (n, 2) m, and which of them are on it.

        Args:
            pixels: columns and rows, (n, 2).
        """
        height, pitch = self._mount
        rays, known = self.rays(pixels)
        cos, sin = math.cos(pitch), math.sin(pitch)
        descent = sin + rays[:, 1] * cos
        valid = np.logical_and(known, descent > _FLATTEST)
        reach = height / np.where(valid, descent, 1.0)
        return np.stack((reach * (cos - rays[:, 1] * sin) + self.forward_m, -reach * rays[:, 0]), axis=1), valid

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Columns and rows of points of the floor, (n, 2) px, and which of them the lens model covers.

        Args:
            points: ahead and left of the car's centre, (n, 2) m.
        """
        height, pitch = self._mount
        cos, sin = math.cos(pitch), math.sin(pitch)
        ahead = points[:, 0] - self.forward_m
        seen = np.stack((-points[:, 1], height * cos - ahead * sin, height * sin + ahead * cos), axis=1)
        limit = self._radii[1][-1]
        inside = np.hypot(seen[:, 0], seen[:, 1]) < limit * np.maximum(seen[:, 2], 1e-6)
        valid = np.logical_and(seen[:, 2] > 1e-6, inside)
        depth = np.where(valid, seen[:, 2], 1.0)
        columns, rows, _ = self.pixels(seen[:, 0] / depth, seen[:, 1] / depth)
        return np.where(valid[:, None], np.stack((columns, rows), axis=1), np.nan), valid


def write_camera(path: Path, camera: FloorCamera) -> None:
    """Write a camera as YAML."""
    lines = []
    for field in fields(camera):
        value = getattr(camera, field.name)
        shown = "null" if value is None else [float(v) for v in value] if field.name == "distortion" else value
        lines.append(f"{field.name}: {shown}\n")
    path.write_text("".join(lines))


def read_camera(path: Path) -> FloorCamera:
    """Read a camera's YAML file.

    Raises:
        RecordingError: it cannot be read, or a value is missing or out of range; one line.
    """
    try:
        found = read_yaml(path, unique_keys=True)
    except (OSError, BoundedYamlError) as error:
        raise RecordingError(
            f"{path}: {getattr(error, 'strerror', None) or error}: give a camera's YAML file"
        ) from None
    names = {field.name for field in fields(FloorCamera)}
    if not isinstance(found, dict) or set(map(str, found)) - names:
        raise RecordingError(f"{path}: expected the keys {', '.join(sorted(names))}: see docs/recordings.md")
    values: dict[str, Any] = {}
    for name, (low, high) in LIMITS.items():
        value = found.get(name)
        if value is None and name in (*MOUNTING, "forward_m", "focal_std"):
            if name in MOUNTING:
                values[name] = None
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise RecordingError(
                f"{path}: {name} is {abbreviated(value)}, expected a number from {low:g} to {high:g}: correct it"
            )
        values[name] = int(value) if name.endswith(("width_px", "height_px")) else float(value)
    lens = found.get("distortion", [0.0] * 5)
    fine = isinstance(lens, list) and len(lens) == 5 and all(isinstance(v, int | float) and abs(v) < 1e3 for v in lens)
    if not fine:
        raise RecordingError(
            f"{path}: distortion is {abbreviated(lens)}, expected five numbers k1, k2, p1, p2, k3: correct it"
        )
    return FloorCamera(**values, distortion=tuple(map(float, lens)))
