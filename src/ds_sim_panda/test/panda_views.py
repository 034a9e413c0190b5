# SPDX-License-Identifier: Apache-2.0
"""Poses, and an independent projection of points into the image of the panda camera."""

from __future__ import annotations

import math

import numpy as np
from camera_reference import seen_from
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState

CAMERA = CameraSpec(horizontal_fov=math.radians(90.0), height=1.25, forward=0.3, pitch=math.radians(8.0))
STRAIGHT = Road([(125.0, 25.0 * i) for i in range(9)])


def pose(x: float, y: float, yaw: float, roll: float = 0.0, pitch: float = 0.0, heave: float = 0.0) -> VehicleState:
    return VehicleState(
        x=x, y=y, yaw=yaw, speed=0.0, yaw_rate=0.0, steering_angle=0.0, roll=roll, pitch=pitch, heave=heave
    )


def lane_pose(road: Road, index: int) -> VehicleState:
    """On the centre of the right lane, along it."""
    (x, y), ahead = road.right_lane_centre[index], np.diff(road.right_lane_centre, axis=0)[index]
    return pose(float(x), float(y), math.atan2(ahead[1], ahead[0]))


def project(spec: CameraSpec, vehicle: VehicleState, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns, rows and distances along the axis of points (n, 3), by SciPy's rotations and the pinhole's formula."""
    forward, left, up = seen_from(spec, vehicle, points).T
    k = spec.intrinsics
    return np.stack((k[0, 2] - k[0, 0] * left / forward, k[1, 2] - k[1, 1] * up / forward, forward), axis=1)
