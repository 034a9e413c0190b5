# SPDX-License-Identifier: Apache-2.0
"""Scene of a painted ground plane under a panorama, seen by a modelled sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.atlas import AtlasMemory, Ground
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.look import Look
from ds_sim.camera.optics import CAMERA_CONDITIONS, OpticsOfRows, camera_under
from ds_sim.camera.renderer import Camera
from ds_sim.camera.sensor import Sensor, scene_rows
from ds_sim.camera.spec import CameraSpec
from ds_sim.camera.surface import SURFACE_CONDITIONS
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.parts import Scene
from ds_sim.simulator import SimulatorError, VehicleState

_SPARE: list[AtlasMemory] = []
"""Memory of unloaded scenes, some 60 MB each: a process needs it for each drive at a time, not for each simulator."""


class PaintedScene(Scene):
    """Implements `ds_sim.parts.Scene` for any camera and look.

    Args:
        camera: camera and its mounting.
        look: appearance of the world.
    """

    conditions = SURFACE_CONDITIONS | CAMERA_CONDITIONS | {"visibility", "sun_azimuth", "sun_elevation"}

    def __init__(self, camera: CameraSpec, look: Look) -> None:
        super().__init__(camera)
        self._look = look
        self._camera_rows = self._rows
        self._camera = Camera(camera, look)
        self._memory: AtlasMemory | None = None
        self._view: _View | None = None
        self._whole: _View | None = None

    def load(self, road: Road, rng: np.random.Generator, conditions: Conditions = DEFAULT) -> None:
        """Paint the ground of a road; see `Scene.load`."""
        self._view = self._whole = None
        self._memory = self._memory or (_SPARE.pop() if _SPARE else AtlasMemory())
        if self._camera_rows != self._rows:
            self._camera_rows = self._rows
            self._camera = Camera(self._spec, self._look, scene_rows(self._spec, self._rows))
        ground_rng, lens_rng = rng.spawn(2)
        look = _lit(self._look, conditions)
        sun = (look.sun_azimuth, look.sun_elevation)
        spec, optics = camera_under(self._spec, conditions, lens_rng, sun=sun, haze=look.horizon)
        camera = self._camera
        if look != self._look or spec != self._spec:
            camera = Camera(spec, look, scene_rows(spec, self._rows))
        self._view = _View(
            camera=camera,
            ground=paint_ground(road, look, self._memory, conditions=conditions, rng=ground_rng),
            sensor=Sensor(spec, rng, self._rows),
            spec=spec,
            rows=self._rows,
            optics=optics,
        )

    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Deliver the next camera image; see `Scene.image`."""
        view = self._loaded()
        return view.sensor.deliver(view.scene(state) if self.drawing else None)

    def still(self, state: VehicleState, rng: np.random.Generator | None = None) -> NDArray[np.uint8]:
        """Take one image from any pose; see `Scene.still`."""
        view = self._loaded()
        if rng is not None:
            return Sensor(replace(view.spec, latency=0), rng, view.rows).deliver(view.scene(state))
        if self._whole is None:
            self._whole = self._whole_of(view)
        return self._whole.sensor.deliver(self._whole.scene(state))

    def unload(self) -> None:
        """Forget the road, and leave the memory of its ground to whichever scene of this process loads one next."""
        if self._memory:
            _SPARE.append(self._memory)
        self.close()

    def close(self) -> None:
        """Release the painted ground."""
        self._view = self._whole = self._memory = None

    def _whole_of(self, view: _View) -> _View:
        """The same view through a sensor without noise, with all rows drawn."""
        rows = (0, self._spec.height_px)
        spec = replace(view.spec, noise=0.0, latency=0)
        return replace(
            view,
            camera=view.camera.with_all_rows,
            sensor=Sensor(spec, np.random.default_rng(0), rows),
            spec=spec,
            rows=rows,
        )

    def _loaded(self) -> _View:
        if self._view is None:
            raise SimulatorError("the scene has no road: load one first")
        return self._view


@dataclass(frozen=True, kw_only=True)
class _View:
    """The world of one road, and what looks at it."""

    camera: Camera
    ground: Ground
    sensor: Sensor
    spec: CameraSpec
    rows: tuple[int, int]
    optics: OpticsOfRows | None

    def scene(self, state: VehicleState) -> NDArray[np.uint8]:
        """What reaches the sensor."""
        image = self.camera.render(self.ground, state)
        if self.optics is None:
            return image
        return self.optics(scene_rows(self.spec, self.rows)).apply(image, *self.camera.view(state))


def _lit(look: Look, conditions: Conditions) -> Look:
    """Look under the sun of conditions."""
    azimuth, elevation = conditions.sun_azimuth, conditions.sun_elevation
    return replace(
        look,
        sun_azimuth=look.sun_azimuth if azimuth is None else azimuth,
        sun_elevation=look.sun_elevation if elevation is None else elevation,
    )
