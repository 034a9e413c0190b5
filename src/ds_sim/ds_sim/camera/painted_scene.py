# SPDX-License-Identifier: Apache-2.0
"""Scene of a painted ground plane under a panorama, seen by a modelled sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.atlas import AtlasMemory, Ground
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.optics import CAMERA_CONDITIONS
from ds_sim.camera.rendered_scene import RenderedScene
from ds_sim.camera.renderer import Camera
from ds_sim.camera.sensor import scene_rows
from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.camera.surface import SURFACE_CONDITIONS
from ds_sim.conditions.model import Conditions
from ds_sim.simulator import SimulatorError, VehicleState

_SPARE: list[AtlasMemory] = []
"""Memory of unloaded scenes, some 60 MB each: a process needs it for each drive at a time, not for each simulator."""


class PaintedScene(RenderedScene):
    """Implements `ds_sim.parts.Scene` for any camera and look.

    Args:
        camera: camera and its mounting.
        look: appearance of the world.
    """

    conditions = SURFACE_CONDITIONS | CAMERA_CONDITIONS | {"visibility", "sun_azimuth", "sun_elevation"}
    only: ClassVar[Mapping[str, object]] = {}
    world_first = True

    def __init__(self, camera: CameraSpec, look: Look) -> None:
        super().__init__(camera)
        self._look, self.haze = look, look.horizon
        self._own_camera = self._camera = Camera(camera, look)
        self._memory: AtlasMemory | None = None
        self._ground: Ground | None = None

    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        self._ground = None
        self._memory = self._memory or (_SPARE.pop() if _SPARE else AtlasMemory())
        look, spec, rows = self._lit(conditions), self._run_spec, scene_rows(self._run_spec, self._run_rows)
        if self._own_camera.rows != rows:
            self._own_camera = Camera(self._spec, self._look, rows)
        changed = look != self._look or spec != self._spec
        self._camera = Camera(spec, look, rows) if changed else self._own_camera
        self._ground = paint_ground(road, look, self._memory, conditions=conditions, rng=rng)

    def _render(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        if self._ground is None:
            raise SimulatorError("the scene has no road: load one first")
        camera = self._camera if self._camera.rows == rows else self._camera.with_all_rows
        return camera.render(self._ground, state)

    def _sun(self, conditions: Conditions) -> tuple[float, float]:
        look = self._lit(conditions)
        return look.sun_azimuth, look.sun_elevation

    def _lit(self, conditions: Conditions) -> Look:
        """Look under the sun of conditions."""
        look, azimuth, elevation = self._look, conditions.sun_azimuth, conditions.sun_elevation
        return replace(
            look,
            sun_azimuth=look.sun_azimuth if azimuth is None else azimuth,
            sun_elevation=look.sun_elevation if elevation is None else elevation,
        )

    def unload(self) -> None:
        """Forget the road, and leave the memory of its ground to whichever scene of this process loads one next."""
        if self._memory:
            _SPARE.append(self._memory)
        self.close()

    def close(self) -> None:
        """Release the painted ground."""
        super().close()
        self._ground = self._memory = None
