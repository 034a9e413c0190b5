"""Scene of a painted ground plane under a panorama, seen by a modelled sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.atlas import AtlasMemory
from ds_sim.camera.ground import Ground, paint_ground
from ds_sim.camera.look import Look
from ds_sim.camera.renderer import Camera
from ds_sim.camera.sensor import Sensor, scene_rows
from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import SimulatorError, VehicleState


class PaintedScene:
    """Implements `ds_sim.scene.Scene` for any camera and look.

    Args:
        camera: camera and its mounting.
        look: appearance of the world.
    """

    def __init__(self, camera: CameraSpec, look: Look) -> None:
        self._spec = camera
        self._look = look
        self._rows = (0, camera.height_px)
        self._camera = Camera(camera, look)
        self._memory = AtlasMemory()
        self._view: _View | None = None

    def draw_rows(self, top: int, bottom: int) -> None:
        """Draw only some rows of the images of the runs to come; see `DrawsRows.draw_rows`."""
        height = self._spec.height_px
        if not 0 <= top < bottom <= height:
            raise ValueError(f"rows {top} to {bottom} are no part of an image: expected 0 <= top < bottom <= {height}")
        if (top, bottom) != self._rows:
            self._rows = (top, bottom)
            self._camera = Camera(self._spec, self._look, scene_rows(self._spec, self._rows))

    def load(self, road: Road, rng: np.random.Generator) -> None:
        """Paint the ground of a road; see `Scene.load`."""
        self._view = None
        self._view = _View(
            camera=self._camera,
            ground=paint_ground(road, self._look, self._memory),
            sensor=Sensor(self._spec, rng, self._rows),
            rows=self._rows,
        )

    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Deliver the next camera image; see `Scene.image`."""
        view = self._loaded()
        return view.sensor.deliver(view.camera.render(view.ground, state))

    def still(self, state: VehicleState, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Take one image from any pose; see `Scene.still`."""
        view = self._loaded()
        sensor = Sensor(replace(self._spec, latency=0), rng, view.rows)
        return sensor.deliver(view.camera.render(view.ground, state))

    def close(self) -> None:
        """Release the painted ground."""
        self._view = None
        self._memory = AtlasMemory()

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
    rows: tuple[int, int]
