# SPDX-License-Identifier: Apache-2.0
"""Coordinate frames of one simulator and the poses between them, as ROS names and orients them (REP-103, REP-105)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState

ROAD_FRAME = "road"
"""Fixed frame of every simulator: x and y in the plane of the road, z up, metres."""
START = 10**9
"""Stamp of the first frame of a bag, and of a node's first run, ns: tf2 takes 0 for `latest`, messages for `unset`."""
_OPTICAL = Rotation.from_quat((-0.5, 0.5, -0.5, 0.5))
"""From a body's frame (forward, left, up) to that of its optical axes (right, down, forward): REP-103."""
_EXACT, _UNKNOWN = 1e-9, 1e12
# Variances of odometry whose planar part is ground truth. All zeros would mean "unknown" (sensor_msgs/Imu) and break
# filters that invert them; robot_localization replaces zeros by 1e-9, and Gazebo's planar_move gives 1e12 to the axes
# that it does not observe. Order: x, y, z, roll, pitch, yaw.
GROUND_TRUTH_COVARIANCE: NDArray[np.float64] = np.diag([_EXACT, _EXACT, _UNKNOWN, _UNKNOWN, _UNKNOWN, _EXACT]).ravel()
"""Row-major 6 x 6 covariance of the pose (m^2, rad^2) and of the twist ((m/s)^2, (rad/s)^2) in odometry."""
GROUND_TRUTH_COVARIANCE.setflags(write=False)

Pose = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Translation x, y, z in m, and rotation as a quaternion x, y, z, w."""


def frame_of(namespace: str, name: str) -> str:
    """Name of a frame in a namespace: `base_link` of the vehicle, or `camera_optical`, whose suffix is REP-103's."""
    return f"{namespace.strip('/')}/{name}".strip("/")


def body_pose(vehicle: VehicleState) -> Pose:
    """Pose of the vehicle in the road frame; its origin is on the ground below the centre when the body is at rest."""
    turn = Rotation.from_euler("ZYX", [vehicle.yaw, vehicle.pitch, vehicle.roll])
    return (vehicle.x, vehicle.y, vehicle.heave), _quaternion(turn)


def camera_pose(camera: CameraSpec) -> Pose:
    """Pose of the camera's optical frame in the vehicle's frame."""
    mount = Rotation.from_euler("Y", camera.pitch)
    if camera.yaw:
        mount = Rotation.from_euler("ZY", [camera.yaw, camera.pitch])
    return (camera.forward, 0.0, camera.height), _quaternion(mount * _OPTICAL)


def _quaternion(turn: Rotation) -> tuple[float, float, float, float]:
    x, y, z, w = (float(v) for v in turn.as_quat())
    return x, y, z, w
