# SPDX-License-Identifier: Apache-2.0
"""Reference images by brute force, with OpenCV's and SciPy's geometry, to compare the camera with."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from ds_sim.camera.atlas import Ground
from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState


def ground_of(levels: Sequence[NDArray[np.uint8]], outside: tuple[int, int, int]) -> Ground:
    """Ground of given rasters, (rows, columns, 3), finest first, with pixels of 0.05 m."""
    opaque = [np.asarray(cv2.cvtColor(level, cv2.COLOR_RGB2RGBA), np.uint8) for level in levels]
    shape = (levels[0].shape[0], levels[0].shape[1])
    return Ground(shape, origin=(0.0, 0.0), resolution=0.05, outside=outside, texture=opaque, lazy_levels=0)


def mounting(spec: CameraSpec, vehicle: VehicleState) -> tuple[Rotation, NDArray[np.float64]]:
    """Orientation of the camera and its optical centre (3,) in the road frame."""
    body = Rotation.from_euler("ZYX", [vehicle.yaw, vehicle.pitch, vehicle.roll])
    centre = np.array([vehicle.x, vehicle.y, vehicle.heave]) + body.apply([spec.forward, 0.0, spec.height])
    return body * Rotation.from_euler("Y", spec.pitch), centre


def seen_from(spec: CameraSpec, vehicle: VehicleState, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far points (n, 3) of the road frame are ahead, to the left and above of the optical centre, (n, 3)."""
    mount, centre = mounting(spec, vehicle)
    return np.asarray(mount.inv().apply(points - centre))


def directions(
    spec: CameraSpec, vehicle: VehicleState, columns: NDArray[np.float64], rows: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays (n, 3) of pixels in the road frame and the optical centre (3,), by OpenCV's undistortion and SciPy."""
    mount, centre = mounting(spec, vehicle)
    pixels = np.stack((columns, rows), axis=-1)[:, None, :]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-9)
    # OpenCV 4 has two functions, OpenCV 5 one for both.
    undistorted = getattr(cv2, "undistortPointsIter", None) or cv2.undistortPoints
    flat = undistorted(pixels, spec.intrinsics, np.array(spec.distortion), None, None, criteria=criteria)
    right, down = flat[:, 0, 0], flat[:, 0, 1]
    return mount.apply(np.stack((np.ones_like(right), -right, -down), axis=1)), centre


def brute_force(spec: CameraSpec, ground: Ground, vehicle: VehicleState, rows: range) -> NDArray[np.float64]:
    """Rows of the image as the mean of 16 x 16 rays per pixel into the finest raster, (rows, columns, 3).

    The raster is read bilinearly. The result is meaningless above the horizon.
    """
    offsets = (np.arange(16) + 0.5) / 16 - 0.5
    level = ground.levels[0]
    frame = np.zeros((len(rows), spec.width, 3))
    v, u = (a.ravel().astype(float) for a in np.meshgrid(rows, np.arange(spec.width), indexing="ij"))
    for down in offsets:
        for right in offsets:
            rays, centre = directions(spec, vehicle, u + right, v + down)
            with np.errstate(divide="ignore"):
                reach = np.where(rays[:, 2] < 0.0, -centre[2] / rays[:, 2], 1e6)
            points = centre[:2] + reach[:, None] * rays[:, :2]
            column, row = ((points - ground.origin) / ground.resolution - 0.5).T
            for channel in range(3):
                frame[..., channel] += map_coordinates(
                    level[..., channel], (row, column), float, order=1, cval=ground.outside[channel]
                ).reshape(frame.shape[:2])
    return frame / 16**2


def below_horizon(spec: CameraSpec, vehicle: VehicleState, rows: range) -> NDArray[np.bool_]:
    """Mask of the pixels of some rows that lie two rows or more below the horizon, (rows, columns)."""
    v, u = (a.ravel().astype(float) for a in np.meshgrid(rows, np.arange(spec.width), indexing="ij"))
    rays, _ = directions(spec, vehicle, u, v - 2.0)
    return np.asarray(rays[:, 2] < 0.0).reshape(len(rows), spec.width)


def psnr(frame: NDArray[np.uint8], reference: NDArray[np.float64]) -> float:
    """Peak signal-to-noise ratio, dB."""
    return float(10 * np.log10(255**2 / np.mean((frame - reference) ** 2)))
