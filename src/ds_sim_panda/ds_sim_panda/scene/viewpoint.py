"""Lens and pose of the camera, in Panda3D's terms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.projection import optical_axes
from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState
from ds_sim_panda.scene.graphics import panda
from ds_sim_panda.scene.parameters import FAR, NEAR

_UNSUPPORTED = {"lens": "pinhole", "gain": 1.0, "gamma": 1.0, "exposure": 0.0, "blur": 0.0, "noise": 0.0, "latency": 0}


def check_camera(spec: CameraSpec) -> None:
    """Check that Panda3D draws this camera as described.

    Raises:
        ValueError: the camera has a property that this scene does not draw.
    """
    for name, expected in _UNSUPPORTED.items():
        if getattr(spec, name) != expected:
            raise ValueError(f"camera.{name} is {getattr(spec, name)}, expected {expected}: PandaScene draws no other")


def make_lens(spec: CameraSpec) -> Any:
    """Panda3D's lens of a pinhole camera with square pixels."""
    lens = panda().PerspectiveLens()
    half = math.tan(spec.horizontal_fov / 2)
    lens.set_fov(math.degrees(spec.horizontal_fov), math.degrees(2 * math.atan(half * spec.height_px / spec.width)))
    lens.set_near_far(NEAR, FAR)
    return lens


def camera_pose(spec: CameraSpec, state: VehicleState) -> NDArray[np.float64]:
    """Pose of the camera in the road frame, (4, 4): rows right, forward, up and position, as Panda3D multiplies."""
    (right, down, forward), position = optical_axes(spec, state)
    pose = np.eye(4)
    pose[:, :3] = right, forward, [-v for v in down], position
    return pose
