# SPDX-License-Identifier: Apache-2.0
"""Base class of scenes that a renderer draws: mounts the camera, and applies optics, conditions and sensor."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.lens import optical_axes
from ds_sim.camera.optics import CAMERA_CONDITIONS, OpticsOfRows, camera_under
from ds_sim.camera.sensor import Sensor, scene_rows
from ds_sim.camera.spec import CameraSpec, Colour
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.parts import Scene
from ds_sim.simulator import SimulatorError, VehicleState

PLAIN = {"lens": "pinhole", "gain": 1.0, "gamma": 1.0, "exposure": 0.0, "blur": 0.0, "noise": 0.0, "latency": 0}
"""Camera whose image is as another renderer draws it."""


class RenderedScene(Scene):
    """Implements `ds_sim.parts.Scene` but for the world itself and its pictures.

    The world belongs to the road: the same road always looks alike, whatever the seed of the run, which conditions and
    the sensor's noise alone use.

    Attributes:
        conditions: conditions that the scene realises.
        haze: colour into which distant things fade by `Optics`; None where the renderer draws haze itself.
        world_first: whether the first of the two random streams of a run is the world's, not the lens's.
        only: properties that the camera must have, or it is refused by a ValueError, as the scene draws no other.
    """

    conditions: ClassVar[frozenset[str]] = CAMERA_CONDITIONS
    haze: Colour | None = None
    only: ClassVar[Mapping[str, object]] = PLAIN
    world_first: ClassVar[bool] = False

    def __init__(self, camera: CameraSpec) -> None:
        for name, expected in self.only.items():
            if (value := getattr(camera, name)) != expected:
                raise ValueError(f"camera.{name} is {value}, expected {expected}: {type(self).__name__} draws no other")
        super().__init__(camera)
        self._run_spec, self._run_rows = camera, self._rows
        self._optics: OpticsOfRows | None = None
        self._sensor: Sensor | None = None
        self._whole: Sensor | None = None
        """Without noise, for all rows."""

    @abstractmethod
    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        """Build the world of a road in place of the last one; `_run_spec` and `_run_rows` are those of the run."""

    @abstractmethod
    def _render(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        """Draw some rows of the world, (rows, columns, 3) uint8 RGB of the whole image; the others are zero.

        Raises:
            SimulatorError: no road is loaded, or the renderer fails.
        """

    @abstractmethod
    def _sun(self, conditions: Conditions) -> tuple[float, float]:
        """Azimuth and elevation of the sun, rad."""

    def load(self, road: Road, rng: np.random.Generator, conditions: Conditions = DEFAULT) -> None:
        """Build the world of a road from scratch; see `Scene.load`."""
        self._sensor = self._whole = None
        self._run_rows = self._rows
        lens_rng, world_rng = rng.spawn(2)
        if self.world_first:
            lens_rng, world_rng = world_rng, lens_rng
        sun = self._sun(conditions)
        self._run_spec, self._optics = camera_under(self._spec, conditions, lens_rng, sun=sun, haze=self.haze)
        self._build(road, conditions, world_rng)
        self._sensor = Sensor(self._run_spec, rng, self._run_rows)

    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Deliver the next camera image; see `Scene.image`."""
        if self._sensor is None:
            raise SimulatorError("the scene has no road: load one first")
        return self._sensor.deliver(self._seen(state, self._run_rows) if self.drawing else None)

    def still(self, state: VehicleState, rng: np.random.Generator | None = None) -> NDArray[np.uint8]:
        """Take one image from any pose; see `Scene.still`."""
        if rng is not None:
            sensor = Sensor(replace(self._run_spec, latency=0), rng, self._run_rows)
            return sensor.deliver(self._seen(state, self._run_rows))
        if self._whole is None:
            self._whole = Sensor(replace(self._run_spec, noise=0.0, latency=0), np.random.default_rng(0))
        return self._whole.deliver(self._seen(state, (0, self._spec.height_px)))

    def close(self) -> None:
        """Release the scene's resources; `load` may follow."""
        self._sensor = self._whole = None

    def _seen(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        """What reaches the sensor."""
        rows = scene_rows(self._run_spec, rows)
        image = self._render(state, rows)
        if self._optics is None:
            return image
        axes, position = optical_axes(self._run_spec, state)
        return self._optics(rows).apply(image, np.array(axes), position[2])
