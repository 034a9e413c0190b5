# SPDX-License-Identifier: Apache-2.0
"""Camera of a recording above a flat floor: its lens, pixels to points of the floor and back, and its YAML file.

The lens models are those of OpenCV and of ROS's `sensor_msgs/CameraInfo`; the file is that of ROS's
`camera_calibration` and `camera_info_manager`, with the camera's place on the car beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_file import FileError, read_regular
from ds_base.bounded_yaml import DEFAULT_LIMITS, load_yaml
from ds_base.folder_files import write_whole
from ds_recording import RecordingError
from ds_road.road import abbreviated

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


_FLATTEST = 0.03
"""Least descent of a ray that is taken to the floor; chosen: beyond, the floor is farther than 30 camera heights."""
LIMITS = {
    "image_width": (16, 8192),
    "image_height": (16, 8192),
    "height_m": (1e-3, 100.0),
    "pitch_rad": (-0.3, 1.4),
    "forward_m": (-100.0, 100.0),
    "focal_std": (0.0, 1e5),
}
"""Least and largest value of each plain number of the file."""
FOCAL, CENTRE = (1.0, 1e5), (-1e4, 1e4)
"""The same for focal lengths, and for the column and row of the optical axis, px."""
MOUNTING = ("height_m", "pitch_rad")
"""What a chessboard does not tell: absent or null in its file, then estimated from the lines."""


@dataclass(frozen=True, kw_only=True)
class FloorCamera:
    """Camera with a lens of OpenCV's models, without roll, above a flat floor."""

    width_px: int
    height_px: int
    focal_px: tuple[float, float]  # focal lengths across and down, px; they differ where pixels are not square
    centre_x_px: float  # column of the optical axis; whole numbers are the centres of pixels
    centre_y_px: float  # row of the optical axis
    height_m: float | None = None  # height of the optical centre above the floor; None if unknown
    pitch_rad: float | None = None  # angle of the optical axis below the horizontal; None if unknown
    forward_m: float = 0.0  # distance of the optical centre ahead of the car's centre
    lens: Lens = Lens()
    focal_std: float = 0.0  # standard deviation of the focal lengths, px

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
            self,
            width_px=columns,
            height_px=rows,
            focal_px=(self.focal_px[0] * x, self.focal_px[1] * y),
            focal_std=self.focal_std * max(x, y),
            centre_x_px=(self.centre_x_px + 0.5) * x - 0.5,
            centre_y_px=(self.centre_y_px + 0.5) * y - 0.5,
        )

    @property
    def horizon_row(self) -> float:
        """Row of the horizon in the middle column."""
        return self.centre_y_px - self.focal_px[1] * math.tan(self._mount[1])

    @property
    def _mount(self) -> tuple[float, float]:
        assert self.height_m is not None and self.pitch_rad is not None
        return self.height_m, self.pitch_rad

    def rays(self, pixels: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Slopes right and down of the rays through pixels, (n, 2), and which of them the lens model covers."""
        return self.lens.slopes((pixels - (self.centre_x_px, self.centre_y_px)) / self.focal_px)

    def pixels(self, right: Rays, down: Rays) -> tuple[Rays, Rays, NDArray[np.bool_]]:
        """Columns and rows of rays with these slopes, px, and which of them the lens model covers."""
        x, y = self.lens.distorted(right, down)
        covered = right * right + down * down < self.lens.reach**2
        return self.centre_x_px + self.focal_px[0] * x, self.centre_y_px + self.focal_px[1] * y, covered

    def floor(self, pixels: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Points of the floor at pixels, (n, 2): ahead and left of the car's centre, (n, 2) m; and which are on it."""
        height, pitch = self._mount
        rays, inside = self.rays(pixels)
        cos, sin = math.cos(pitch), math.sin(pitch)
        descent = sin + rays[:, 1] * cos
        valid = np.logical_and(inside, descent > _FLATTEST)
        reach = height / np.where(valid, descent, 1.0)
        return np.stack((reach * (cos - rays[:, 1] * sin) + self.forward_m, -reach * rays[:, 0]), axis=1), valid

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Columns and rows, (n, 2) px, of points of the floor, (n, 2) m, and which of them the lens model covers."""
        height, pitch = self._mount
        cos, sin = math.cos(pitch), math.sin(pitch)
        ahead = points[:, 0] - self.forward_m
        in_camera = np.stack((-points[:, 1], height * cos - ahead * sin, height * sin + ahead * cos), axis=1)
        inside = np.hypot(in_camera[:, 0], in_camera[:, 1]) < self.lens.reach * np.maximum(in_camera[:, 2], 1e-6)
        valid = np.logical_and(in_camera[:, 2] > 1e-6, inside)
        depth = np.where(valid, in_camera[:, 2], 1.0)
        columns, rows, _ = self.pixels(in_camera[:, 0] / depth, in_camera[:, 1] / depth)
        return np.where(valid[:, None], np.stack((columns, rows), axis=1), np.nan), valid


def write_camera(path: Path, camera: FloorCamera) -> None:
    """Write a camera as the YAML file of ROS's `camera_calibration`, with the place on the car beside it."""
    (fx, fy), cx, cy = camera.focal_px, camera.centre_x_px, camera.centre_y_px

    def matrix(rows: int, columns: int, values: Sequence[float]) -> str:
        return f"\n  rows: {rows}\n  cols: {columns}\n  data: {[float(value) for value in values]}"

    values = {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": "camera",
        "camera_matrix": matrix(3, 3, (fx, 0, cx, 0, fy, cy, 0, 0, 1)),
        "distortion_model": camera.lens.model,
        "distortion_coefficients": matrix(1, len(camera.lens.coefficients), camera.lens.coefficients),
        "rectification_matrix": matrix(3, 3, (1, 0, 0, 0, 1, 0, 0, 0, 1)),
        "projection_matrix": matrix(3, 4, (fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0)),
        **{name: "null" if getattr(camera, name) is None else getattr(camera, name) for name in MOUNTING},
        "forward_m": camera.forward_m,
        "focal_std": camera.focal_std,
    }
    write_whole(path, "".join(f"{name}: {value}\n".replace(": \n", ":\n") for name, value in values.items()))


def read_camera(path: Path) -> FloorCamera:
    """Read a camera's YAML file, as `write_camera` or ROS's `camera_calibration` writes it.

    Files of OpenCV's `FileStorage` are read too, and of Kalibr's camera chains the first camera. RecordingError if it
    cannot be read, or a value is missing or out of range.
    """
    try:
        text = read_regular(path, DEFAULT_LIMITS.size).replace(b"!!opencv-matrix", b"")
        content = load_yaml(text.replace(b"%YAML:1.0", b"", 1), unique_keys=True)
    except (OSError, FileError) as error:
        raise RecordingError(
            f"{path}: {getattr(error, 'strerror', None) or error}: give a camera's YAML file"
        ) from None
    if not isinstance(content, dict):
        raise RecordingError(f"{path}: expected a camera's YAML file with a camera_matrix: see docs/recordings.md")
    content = {str(name): value for name, value in content.items()}
    if isinstance(chain := content.get("cam0"), dict):
        content = _of_kalibr(chain)
    values: dict[str, Any] = {}
    for name, (low, high) in LIMITS.items():
        if content.get(name) is None and not name.startswith("image_"):
            values[name] = None if name in MOUNTING else 0.0
        else:
            values[name] = _number(path, name, content.get(name), low, high)
    matrix = _data(path, content, "camera_matrix", (9,))
    if matrix[1] != 0.0 or matrix[3] != 0.0:
        raise RecordingError(f"{path}: camera_matrix has a skew of {matrix[1]:g}, expected 0: calibrate without skew")
    fx, fy = (_number(path, "camera_matrix", matrix[at], *FOCAL) for at in (0, 4))
    cx, cy = (_number(path, "camera_matrix", matrix[at], *CENTRE) for at in (2, 5))
    return FloorCamera(
        width_px=int(values.pop("image_width")),
        height_px=int(values.pop("image_height")),
        focal_px=(fx, fy),
        centre_x_px=cx,
        centre_y_px=cy,
        lens=_lens(path, content),
        **values,
    )


def _lens(path: Path, content: Mapping[str, Any]) -> Lens:
    model = content.get("distortion_model", "plumb_bob")
    model = "equidistant" if model == "fisheye" else model
    if model not in list(MODELS):  # it may be of any type
        raise RecordingError(
            f"{path}: distortion_model is {abbreviated(model)}, expected {', '.join(MODELS)}, fisheye: calibrate again"
        )
    wanted = MODELS[model]
    coefficients = _data(path, content, "distortion_coefficients", (0, 4, 5, 8, 12, 14))
    if any(coefficients[wanted:]) or (model == "equidistant" and len(coefficients) != wanted):
        raise RecordingError(
            f"{path}: {model} has {len(coefficients)} distortion_coefficients, expected {wanted}: calibrate again"
        )
    return Lens(model, (*coefficients, *[0.0] * wanted)[:wanted])


def _of_kalibr(camera: Mapping[str, Any]) -> dict[str, Any]:
    lists = (camera.get(name) for name in ("intrinsics", "resolution", "distortion_coeffs"))
    intrinsics, resolution, coefficients = (entry if isinstance(entry, list) else [] for entry in lists)
    fx, fy, cx, cy = [*intrinsics, *[None] * 4][:4]
    model = camera.get("distortion_model") if camera.get("camera_model") == "pinhole" else camera.get("camera_model")
    return {
        **dict(zip(("image_width", "image_height"), resolution, strict=False)),
        "camera_matrix": {"data": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]},
        "distortion_model": "plumb_bob" if model == "radtan" else model,
        "distortion_coefficients": {"data": coefficients},
    }


def _data(path: Path, content: Mapping[str, Any], name: str, sizes: Sequence[int]) -> list[float]:
    """Numbers of a matrix; those of a list without rows and columns, too."""
    entry = content.get(name)
    data = entry.get("data") if isinstance(entry, dict) else entry
    if not isinstance(data, list) or len(data) not in sizes:
        expected = " or ".join(map(str, sizes))
        raise RecordingError(f"{path}: {name} is {abbreviated(entry)}, expected data of {expected} numbers: correct it")
    return [_number(path, name, value, -1e6, 1e6) for value in data]


def _number(path: Path, name: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise RecordingError(
            f"{path}: {name} is {abbreviated(value)}, expected a number from {low:g} to {high:g}: correct it"
        )
    return float(value)
