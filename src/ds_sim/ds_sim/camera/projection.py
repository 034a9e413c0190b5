"""Projects points of the ground into the image of a camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ds_sim.camera.spec import CameraSpec
from ds_sim.frames import body_pose, camera_pose
from ds_sim.simulator import VehicleState

NEAREST = 0.5
"""Least distance along the optical axis from which points are projected, m; chosen: nearer ones are below every
image."""


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
    (place, turn), (mount, optical) = body_pose(vehicle), camera_pose(camera)
    body = Rotation.from_quat(turn)
    centre = np.array(place) + body.apply(mount)
    axes = (body * Rotation.from_quat(optical)).as_matrix()
    seen = (np.column_stack((ground, np.zeros(len(ground)))) - centre) @ axes
    depths = seen[:, 2]
    pixels = np.full((len(ground), 2), np.nan)
    front = depths > NEAREST
    if front.any():
        distortion = np.array(camera.distortion)
        found, _ = cv2.projectPoints(seen[front], np.zeros(3), np.zeros(3), camera.intrinsics, distortion)
        pixels[front] = found[:, 0]
    return pixels, depths
