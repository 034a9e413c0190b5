"""Projects points of the ground into the image of a camera."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState

Vector = tuple[float, float, float]

NEAREST = 0.5
"""Least distance along the optical axis from which points are projected, m; chosen: nearer ones are below every
image."""


def optical_axes(spec: CameraSpec, vehicle: VehicleState) -> tuple[tuple[Vector, Vector, Vector], Vector]:
    """Optical axes right, down, forward in the road frame, and the optical centre, m.

    The body rotates about its centre at ground level, a common simplification of roll and pitch centres: yaw, then
    pitch, then roll (REP-103).
    """
    yaw, pitch, roll = vehicle.yaw, vehicle.pitch, vehicle.roll
    cy, sy, cp, sp, cr, sr = (
        math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll),
    )  # fmt: skip
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
            fx * cw - rx * sw, fy * cw - ry * sw, fz * cw - rz * sw,
            (rx * cw + fx * sw, ry * cw + fy * sw, rz * cw + fz * sw),
        )  # fmt: skip
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
    seen = np.stack([dx * a + dy * b - z * c for a, b, c in axes], axis=1)
    depths = seen[:, 2]
    pixels = np.full((len(ground), 2), np.nan)
    front = depths > NEAREST
    if front.any():
        distortion = np.array(camera.distortion)
        found, _ = cv2.projectPoints(seen[front], np.zeros(3), np.zeros(3), camera.intrinsics, distortion)
        pixels[front] = found[:, 0]
    return pixels, depths
