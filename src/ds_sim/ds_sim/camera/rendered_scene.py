# SPDX-License-Identifier: Apache-2.0
"""Base class of scenes drawn by another renderer: mounts the camera, and applies conditions to its images."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.lens import Vector, optical_axes
from ds_sim.camera.look import Colour
from ds_sim.camera.optics import CAMERA_CONDITIONS, OpticsOfRows, camera_under
from ds_sim.camera.sensor import Sensor, blank
from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.parts import Scene
from ds_sim.simulator import VehicleState

Axes = tuple[Vector, Vector, Vector]
"""Optical axes right, down, forward in the road frame, unit vectors."""

_UNSUPPORTED = {"lens": "pinhole", "gain": 1.0, "gamma": 1.0, "exposure": 0.0, "blur": 0.0, "noise": 0.0, "latency": 0}


class RenderedScene(Scene):
    """Implements `ds_sim.parts.Scene` but for the world itself and its pictures.

    The world belongs to the road: the same road always looks alike, whatever the seed of the run, which conditions
    alone use. The camera has neither noise nor latency, unless conditions give it noise.

    Args:
        camera: pinhole camera.

    Attributes:
        conditions: conditions that the scene realises.
        haze: colour into which distant things fade by `Optics`; None where the renderer draws haze itself.

    Raises:
        ValueError: the camera has a property that such a scene does not draw.
    """

    conditions: ClassVar[frozenset[str]] = CAMERA_CONDITIONS
    haze: ClassVar[Colour | None] = None

    def __init__(self, camera: CameraSpec) -> None:
        for name, expected in _UNSUPPORTED.items():
            if getattr(camera, name) != expected:
                value = getattr(camera, name)
                raise ValueError(f"camera.{name} is {value}, expected {expected}: {type(self).__name__} draws no other")
        super().__init__(camera)
        self._run_rows = self._rows
        self._view = _View(spec=camera)

    @abstractmethod
    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        """Build the world of a road in place of the last one; `rng` is used by conditions alone."""

    @abstractmethod
    def _render(self, spec: CameraSpec, axes: Axes, position: Vector, rows: tuple[int, int]) -> NDArray[np.uint8]:
        """Draw some rows of the world, (rows, columns, 3) uint8 RGB of the whole image, others zero, writable.

        Raises:
            SimulatorError: no road is loaded, or the renderer fails.
        """

    @abstractmethod
    def _sun(self, conditions: Conditions) -> Vector:
        """Direction of the sun, a unit vector in the road frame."""

    def load(self, road: Road, rng: np.random.Generator, conditions: Conditions = DEFAULT) -> None:
        """Build the world of a road from scratch; `rng` is used by conditions alone."""
        self._run_rows = self._rows
        lens_rng, world_rng = (rng, rng) if conditions.is_default else rng.spawn(2)
        x, y, z = self._sun(conditions)
        sun = (math.atan2(y, x), math.asin(z))
        spec, optics = camera_under(self._spec, conditions, lens_rng, sun=sun, haze=self.haze)
        self._view = _View(spec=spec, optics=optics, sensor=Sensor(spec, rng, self._run_rows) if spec.noise else None)
        self._build(road, conditions, world_rng)

    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Deliver the next camera image, (rows, columns, 3) uint8 RGB, read-only."""
        image = self._seen(state, self._run_rows) if self.drawing else None
        if self._view.sensor is not None:
            return self._view.sensor.deliver(image)
        return blank(self._spec) if image is None else image

    def still(self, state: VehicleState, rng: np.random.Generator | None = None) -> NDArray[np.uint8]:
        """Take one image from any pose; see `Scene.still`. `rng` is used by conditions alone."""
        if rng is None:
            return self._seen(state, (0, self._spec.height_px))
        image = self._seen(state, self._run_rows)
        return image if self._view.sensor is None else Sensor(self._view.spec, rng, self._run_rows).deliver(image)

    def _seen(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        """What reaches the sensor, read-only."""
        view = self._view
        axes, position = optical_axes(view.spec, state)
        image = self._render(view.spec, axes, position, rows)
        if view.optics is not None:
            image = view.optics(rows).apply(image, np.array(axes), position[2])
        image.setflags(write=False)
        return image


@dataclass(frozen=True, kw_only=True)
class _View:
    """Camera of one run, and what conditions put before and behind its lens."""

    spec: CameraSpec
    optics: OpticsOfRows | None = None
    sensor: Sensor | None = None
