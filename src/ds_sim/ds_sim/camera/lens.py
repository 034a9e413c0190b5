# SPDX-License-Identifier: Apache-2.0
"""Maps pixels of a camera to rays, and points of the ground to pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState

_NEWTON_STEPS = 8
"""Chosen: the start is within 1e-4 of the root, three steps reach the last digit, and more cost nothing."""


def rays(spec: CameraSpec, columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions (right, down, forward) of the rays through pixels, (3, ...); columns and rows are broadcast.

    Rays of a pinhole have forward = 1, those of a wide-angle lens have length 1. In both cases a pixel is
    1 / focal length wide at distance 1 along its ray: exactly for the pinhole, within a few percent for the lens.
    """
    k = spec.intrinsics
    right, down = np.broadcast_arrays((columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1])
    if spec.lens == "pinhole":
        return np.stack((right, down, np.ones_like(right)))
    distorted = np.hypot(right, down)
    undistorted = _undistorted_radius(spec, distorted)
    stretch = np.where(distorted > 0.0, undistorted / np.maximum(distorted, 1e-12), 1.0)
    forward = 1.0 / np.sqrt(1.0 + undistorted**2)
    return np.stack((right * stretch * forward, down * stretch * forward, forward))


def _undistorted_radius(spec: CameraSpec, distorted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radius in a pinhole image for a radius in the lens image, by Newton's method from the equidistant model."""
    k1, k2, _, _, k3, k4, k5, k6 = spec.distortion
    above, below = np.polynomial.Polynomial([1, k1, k2, k3]), np.polynomial.Polynomial([1, k4, k5, k6])
    above_slope, below_slope = above.deriv(), below.deriv()
    radius = np.tan(np.minimum(distorted, 1.5))
    for _ in range(_NEWTON_STEPS):
        t = radius**2
        a, b = above(t), below(t)
        slope = a / b + 2 * t * (above_slope(t) * b - a * below_slope(t)) / b**2
        radius = radius - (radius * a / b - distorted) / slope
    return np.asarray(radius)


@lru_cache(maxsize=32)
def sample_rays(spec: CameraSpec, samples: int) -> NDArray[np.float32]:
    """Rays of a whole image, with `samples` rays stacked vertically in every pixel, (samples, 3, rows * columns)."""
    columns, rows = np.arange(spec.width, dtype=np.float64), np.arange(spec.height_px, dtype=np.float64)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    table = np.stack([rays(spec, columns[None, :], (rows + offset)[:, None]).reshape(3, -1) for offset in offsets])
    return table.astype(np.float32)


@lru_cache(maxsize=32)
def pinhole_slopes(spec: CameraSpec, samples: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Components right (columns,) and down (samples, rows) of `sample_rays` of a pinhole, of which forward is 1."""
    columns, rows = np.arange(spec.width, dtype=np.float64), np.arange(spec.height_px, dtype=np.float64)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    right, down = rays(spec, columns, rows[:1])[0], rays(spec, columns[:1], rows + offsets[:, None])[1]
    return right.astype(np.float32), down.astype(np.float32)


SPARE_RAYS = 16
"""Rays to transform beyond those needed: OpenCV rounds the last ones of a call differently, fewer than a vector."""


@lru_cache(maxsize=32)
def reversed_rays(spec: CameraSpec, samples: int) -> NDArray[np.float32]:
    """Rays of `sample_rays` as forward, down, right, with spare ones at the end, (samples, rows * columns + 16, 3).

    In this order `cv2.transform`, with the columns of its matrix reversed, has the bits of `components`.
    """
    table = np.zeros((samples, spec.height_px * spec.width + SPARE_RAYS, 3), np.float32)
    table[:, :-SPARE_RAYS] = sample_rays.__wrapped__(spec, samples)[:, ::-1].swapaxes(1, 2)
    return table


def components(rays: NDArray[np.float32], axis: Sequence[float]) -> NDArray[np.float32]:
    """Components of rays (3, ...) along an axis, (...), in single precision.

    They are scalar products without BLAS, which rounds by the type of processor.
    """
    first, second, third = axis
    out = np.multiply(rays[0], np.float32(first))
    cv2.scaleAdd(rays[1], second, out, out)
    cv2.scaleAdd(rays[2], third, out, out)
    return out


Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]
"""Optical axes right, down, forward, unit vectors."""

NEAREST = 0.5
"""Least distance along the optical axis from which points are projected, m; chosen: nearer ones are below every
image."""


def optical_axes(spec: CameraSpec, vehicle: VehicleState) -> tuple[Axes, Vector]:
    """Optical axes right, down, forward in the road frame, and the optical centre, m.

    The body rotates about its centre at ground level, a common simplification of roll and pitch centres: yaw, then
    pitch, then roll (REP-103).
    """
    cy, sy = math.cos(vehicle.yaw), math.sin(vehicle.yaw)
    cp, sp = math.cos(vehicle.pitch), math.sin(vehicle.pitch)
    cr, sr = math.cos(vehicle.roll), math.sin(vehicle.roll)
    fx, fy, fz = cy * cp, sy * cp, -sp
    ux, uy, uz = cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr
    ahead, above = spec.forward, spec.height
    position = (
        vehicle.x + fx * ahead + ux * above,
        vehicle.y + fy * ahead + uy * above,
        vehicle.heave + fz * ahead + uz * above,
    )
    ct, st = math.cos(spec.pitch), math.sin(spec.pitch)
    right = (-(cy * sp * sr - sy * cr), -(sy * sp * sr + cy * cr), -(cp * sr))
    if spec.yaw:
        rx, ry, rz = right
        cw, sw = math.cos(spec.yaw), math.sin(spec.yaw)
        fx, fy, fz, right = (
            fx * cw - rx * sw,
            fy * cw - ry * sw,
            fz * cw - rz * sw,
            (rx * cw + fx * sw, ry * cw + fy * sw, rz * cw + fz * sw),
        )
    down = (-(ux * ct + fx * st), -(uy * ct + fy * st), -(uz * ct + fz * st))
    forward = (fx * ct - ux * st, fy * ct - uy * st, fz * ct - uz * st)
    return (right, down, forward), position


def project(
    ground: NDArray[np.float64], vehicle: VehicleState, camera: CameraSpec
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project points of the ground as the lens shows them.

    Args:
        ground: x and y in the road frame, (n, 2) m.
        vehicle: vehicle when the image is exposed.
        camera: camera and its mounting.

    Returns:
        Columns and rows, (n, 2) px, whole numbers at the centres of pixels, NaN for points nearer than `NEAREST` or
        behind the camera; and distances along the optical axis, (n,) m.

    Examples:
        >>> import numpy as np
        >>> from ds_sim import VehicleState, project, spec_of
        >>> vehicle = VehicleState(x=0.0, y=0.0, yaw=np.pi / 2, speed=0.0, yaw_rate=0.0, steering_angle=0.0)
        >>> pixels, depths = project(np.array([[0.0, 20.0]]), vehicle, spec_of("bullet").camera)
        >>> bool(abs(pixels[0, 0] - 160) < 1), bool(depths[0] > 0)
        (True, True)
    """
    axes, (x, y, z) = optical_axes(camera, vehicle)
    dx, dy = ground[:, 0] - x, ground[:, 1] - y
    in_camera = np.stack([dx * a + dy * b - z * c for a, b, c in axes], axis=1)
    depths = in_camera[:, 2]
    pixels = np.full((len(ground), 2), np.nan)
    front = depths > NEAREST
    if front.any():
        distortion = np.array(camera.distortion)
        projected, _ = cv2.projectPoints(in_camera[front], np.zeros(3), np.zeros(3), camera.intrinsics, distortion)
        pixels[front] = projected[:, 0]
    return pixels, depths
