"""Scene of the simulator `panda`: a world and a camera drawn by Panda3D."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.lens import optical_axes
from ds_sim.camera.optics import (
    LENS_CONDITIONS,
    MOUNT_CONDITIONS,
    SENSOR_CONDITIONS,
    Optics,
    mounted,
    noise_of,
    optics_of,
)
from ds_sim.camera.sensor import Sensor
from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.parts import check_rows
from ds_sim.simulator import SimulatorError, VehicleState
from ds_sim_panda.scene.graphics import graphics, panda
from ds_sim_panda.scene.parameters import FAR, NEAR
from ds_sim_panda.scene.setting import WORLD_CONDITIONS, Setting, sun_direction
from ds_sim_panda.scene.world import World

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


class PandaScene:
    """Implements `ds_sim.parts.Scene` with Panda3D: textured meshes, shadows of the sun, haze.

    The world belongs to the road: the same road always looks alike, whatever the seed of the run, which decides alone
    where conditions cover it. The camera has neither noise nor latency, unless conditions give it noise.

    Args:
        camera: pinhole camera.

    Raises:
        ValueError: the camera has a property that this scene does not draw.
        ImportError: Panda3D is not installed.
        SimulatorError: EGL or Mesa's software renderer is missing.
    """

    conditions = WORLD_CONDITIONS | LENS_CONDITIONS | SENSOR_CONDITIONS | MOUNT_CONDITIONS
    """Conditions that this scene realises."""

    def __init__(self, camera: CameraSpec) -> None:
        check_camera(camera)
        graphics()
        self._spec = camera
        self._rows = self._run_rows = (0, camera.height_px)
        self._camera = panda().NodePath(panda().Camera("camera", make_lens(camera)))
        self._world: World | None = None
        self._view = _View(spec=camera)

    def load(self, road: Road, rng: np.random.Generator, conditions: Conditions = DEFAULT) -> None:
        """Build the world of a road from scratch; `rng` is used by conditions alone."""
        self._world = None
        self._run_rows = self._rows
        lens_rng, world_rng = (rng, rng) if conditions.is_default else rng.spawn(2)
        self._view = self._under(conditions, rng, lens_rng)
        changed = WORLD_CONDITIONS & conditions.changed.keys()
        self._world = World(road, Setting(conditions, world_rng) if changed else None)

    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Deliver the next camera image, (rows, columns, 3) uint8 RGB, read-only."""
        image = self._draw(state, self._run_rows)
        return image if self._view.sensor is None else self._view.sensor.deliver(image)

    def still(self, state: VehicleState, rng: np.random.Generator | None = None) -> NDArray[np.uint8]:
        """Take one image from any pose; see `Scene.still`. `rng` is used by conditions alone."""
        if rng is None:
            return self._draw(state, (0, self._spec.height_px))
        image = self._draw(state, self._run_rows)
        return image if self._view.sensor is None else Sensor(self._view.spec, rng, self._run_rows).deliver(image)

    def draw_rows(self, top: int, bottom: int) -> None:
        """Draw only some rows of the images of the runs to come."""
        check_rows(top, bottom, self._spec)
        self._rows = (top, bottom)

    def close(self) -> None:
        """Release the world; `load` may follow."""
        self._world = None

    def _under(self, conditions: Conditions, rng: np.random.Generator, lens_rng: np.random.Generator) -> _View:
        """Make the camera of a run under its conditions."""
        if not (LENS_CONDITIONS | SENSOR_CONDITIONS | MOUNT_CONDITIONS) & conditions.changed.keys():
            return _View(spec=self._spec)
        spec = replace(mounted(self._spec, conditions), noise=noise_of(self._spec, conditions))
        optics = None
        if LENS_CONDITIONS & conditions.changed.keys():
            x, y, z = sun_direction(conditions)
            optics = optics_of(spec, conditions, lens_rng, sun=(math.atan2(y, x), math.asin(z)))
        return _View(spec=spec, optics=optics, sensor=Sensor(spec, rng, self._run_rows) if spec.noise else None)

    def _draw(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        world, view = self._world, self._view
        spec = view.spec
        if world is None:
            raise SimulatorError("the scene has no road: load one first")
        pose = camera_pose(spec, state)
        pose[3, :2] -= world.origin
        self._camera.reparent_to(world.root)
        self._camera.set_mat(panda().LMatrix4(*pose.ravel().tolist()))
        world.follow(*pose[3, :3].tolist())
        top, bottom = rows
        drawn = graphics().draw(self._camera, spec.width, spec.height_px, top=top)[::-1]
        image = np.zeros((spec.height_px, spec.width, 3), np.uint8)
        cv2.cvtColor(drawn[: bottom - top], cv2.COLOR_BGR2RGB, image[top:bottom])
        if view.optics is not None:
            image = view.optics(rows).apply(image, pose[:3, :3][[0, 2, 1]] * [[1.0], [-1.0], [1.0]], float(pose[3, 2]))
        image.setflags(write=False)
        return image


@dataclass(frozen=True, kw_only=True)
class _View:
    """Camera of one run, and what conditions put before and behind its lens."""

    spec: CameraSpec
    optics: Callable[[tuple[int, int]], Optics] | None = None
    sensor: Sensor | None = None
