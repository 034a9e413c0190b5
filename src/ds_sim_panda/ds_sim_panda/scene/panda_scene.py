# SPDX-License-Identifier: Apache-2.0
"""Scene of the simulator `panda`: a world and a camera drawn by Panda3D."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.lens import Axes, Vector, optical_axes
from ds_sim.camera.optics import CAMERA_CONDITIONS
from ds_sim.camera.rendered_scene import RenderedScene
from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.simulator import SimulatorError, VehicleState
from ds_sim_panda.scene.graphics import graphics, panda
from ds_sim_panda.scene.parameters import FAR, NEAR
from ds_sim_panda.scene.setting import WORLD_CONDITIONS, Setting, sun_direction
from ds_sim_panda.scene.world import World


def make_lens(spec: CameraSpec) -> Any:
    """Panda3D's lens of a pinhole camera with square pixels."""
    lens = panda().PerspectiveLens()
    half = math.tan(spec.horizontal_fov / 2)
    lens.set_fov(math.degrees(spec.horizontal_fov), math.degrees(2 * math.atan(half * spec.height_px / spec.width)))
    lens.set_near_far(NEAR, FAR)
    return lens


def camera_pose(axes: Axes, position: Vector) -> NDArray[np.float64]:
    """Pose of the camera in the road frame, (4, 4): rows right, forward, up and position, as Panda3D multiplies."""
    right, down, forward = axes
    pose = np.eye(4)
    pose[:, :3] = right, forward, [-v for v in down], position
    return pose


class PandaScene(RenderedScene):
    """Implements `ds_sim.parts.Scene` with Panda3D: textured meshes, shadows of the sun, haze; for a pinhole camera.

    Raises:
        ImportError: Panda3D is not installed.
        SimulatorError: EGL or Mesa's software renderer is missing.
    """

    conditions = WORLD_CONDITIONS | CAMERA_CONDITIONS

    def __init__(self, camera: CameraSpec) -> None:
        super().__init__(camera)
        graphics()
        self._camera = panda().NodePath(panda().Camera("camera", make_lens(camera)))
        self._world: World | None = None
        x, y, z = sun_direction(DEFAULT)
        self.sun = math.atan2(y, x), math.asin(z)

    def close(self) -> None:
        """Release the world; `load` may follow."""
        super().close()
        self._world = None

    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        self._world = None
        changed = WORLD_CONDITIONS & conditions.changed.keys()
        self._world = World(road, Setting(conditions, rng) if changed else None)

    def _render(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        world, spec = self._world, self._run_spec
        if world is None:
            raise SimulatorError("the scene has no road: load one first")
        pose = camera_pose(*optical_axes(spec, state))
        pose[3, :2] -= world.origin
        self._camera.reparent_to(world.root)
        self._camera.set_mat(panda().LMatrix4(*pose.ravel().tolist()))
        world.follow(*pose[3, :3].tolist())
        top, bottom = rows
        drawn = graphics().draw(self._camera, spec.width, spec.height_px, top=top)[::-1]
        image = np.zeros((spec.height_px, spec.width, 3), np.uint8)
        cv2.cvtColor(drawn[: bottom - top], cv2.COLOR_BGR2RGB, image[top:bottom])
        return image
