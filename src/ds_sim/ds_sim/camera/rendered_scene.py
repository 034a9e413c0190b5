# SPDX-License-Identifier: Apache-2.0
"""Image sensor, scenes that a renderer draws and it sees through optics, and the one of painted ground."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.atlas import AtlasMemory, Ground
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.lens import optical_axes
from ds_sim.camera.optics import CAMERA_CONDITIONS, Optics, camera_under
from ds_sim.camera.renderer import Camera
from ds_sim.camera.spec import CameraSpec, Colour, Look
from ds_sim.camera.surface import SURFACE_CONDITIONS
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.parts import Scene
from ds_sim.simulator import SimulatorError, VehicleState

_NOISE_MARGIN = 64
PLAIN = {"lens": "pinhole", "gain": 1.0, "gamma": 1.0, "exposure": 0.0, "blur": 0.0, "noise": 0.0, "latency": 0}
"""Camera whose image is as another renderer draws it."""
_SPARE: list[AtlasMemory] = []
"""Memory of unloaded scenes, some 60 MB each: a process needs it for each drive at a time, not for each simulator."""


class Sensor:
    """Converts rendered scenes to delivered images, for one run.

    Args:
        spec: camera.
        rng: source of the noise.
        rows: first row and end of the rows that are delivered; all rows if omitted. The others are zero.
    """

    def __init__(self, spec: CameraSpec, rng: np.random.Generator, rows: tuple[int, int] | None = None) -> None:
        self._spec = spec
        self._rng = rng
        self._rows = slice(*(rows or (0, spec.height_px)))
        levels = np.arange(256) / 255.0
        self._response = np.clip(255.0 * (spec.gain * levels) ** spec.gamma, 0, 255).round().astype(np.uint8)
        self._is_linear = np.array_equal(self._response, np.arange(256))
        self._noise: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None
        if spec.noise > 0.0:
            shape = (spec.height_px + _NOISE_MARGIN, spec.width + _NOISE_MARGIN, 3)
            plate = rng.standard_normal(shape)
            if spec.noise_blur > 0.0:
                plate = np.asarray(cv2.GaussianBlur(plate, (0, 0), spec.noise_blur))
            if spec.noise_colour < 1.0:
                grey = plate[:, :, 0] * np.sqrt(1 - spec.noise_colour**2)
                plate *= spec.noise_colour
                plate += cv2.merge((grey, grey, grey))  # NumPy is slow where it repeats numbers within a pixel
            plate *= spec.noise / plate.std()
            signed = np.rint(plate, plate).astype(np.int16)
            # Bytes that are added or taken away saturate as signed noise does, and are much faster.
            self._noise = (signed.clip(0, 255).astype(np.uint8), (-signed).clip(0, 255).astype(np.uint8))
        self._delayed: list[NDArray[np.uint8]] = []
        self._blank = np.broadcast_to(np.zeros(1, np.uint8), (spec.height_px, spec.width, 3))

    def deliver(self, scene: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        """Expose one image and return the one that arrives now, `latency` frames late (at first the very first one).

        Args:
            scene: (rows, columns, 3) uint8 RGB, of which `scene_rows` are read; None for a blank image.
        """
        # A random window of one precomputed noise plate is much cheaper than new noise for each image.
        row, column = (0, 0) if self._noise is None else self._rng.integers(0, _NOISE_MARGIN, 2).tolist()
        self._delayed.append(self._blank if scene is None else self._exposed(scene, row, column))
        if len(self._delayed) > self._spec.latency + 1:
            self._delayed.pop(0)
        return self._delayed[0]

    def _exposed(self, scene: NDArray[np.uint8], row: int, column: int) -> NDArray[np.uint8]:
        """Expose one image, with the window of the noise plate that begins at a row and a column."""
        spec = self._spec
        delivered = np.empty(scene.shape, np.uint8)
        delivered[: self._rows.start] = delivered[self._rows.stop :] = 0
        image, light = delivered[self._rows], scene[self._rows]
        if spec.blur > 0.0:
            first, last = scene_rows(spec, (self._rows.start, self._rows.stop))
            blurred = np.asarray(cv2.GaussianBlur(scene[first:last], (0, 0), spec.blur), np.uint8)
            light = blurred[self._rows.start - first : self._rows.stop - first]
        if not self._is_linear:
            light = cv2.LUT(light, self._response, image)
        if self._noise is not None:
            rows = slice(self._rows.start + row, self._rows.stop + row)
            more, less = (plate[rows, column : column + spec.width] for plate in self._noise)
            light = cv2.subtract(cv2.add(light, more, image), less, image)
        if light is not image:
            image[:] = light
        delivered.setflags(write=False)
        return delivered


def scene_rows(spec: CameraSpec, rows: tuple[int, int]) -> tuple[int, int]:
    """First row and end of the rows of a scene on which some rows of the delivered image depend."""
    if spec.blur <= 0.0:
        return rows
    # OpenCV's kernel for bytes ends at three standard deviations.
    reach = math.ceil(3.0 * spec.blur) + 1
    return max(rows[0] - reach, 0), min(rows[1] + reach, spec.height_px)


class RenderedScene(Scene):
    """Implements `ds_sim.parts.Scene` but for the world itself and its pictures.

    The world belongs to the road: the same road always looks alike, whatever the seed of the run, which conditions and
    the sensor's noise alone use.

    Attributes:
        conditions: conditions that the scene realises.
        sun: azimuth and elevation of the sun, rad, where conditions do not say.
        haze: colour into which distant things fade by `Optics`; None where the renderer draws haze itself.
        world_first: whether the first of the two random streams of a run is the world's, not the lens's.
        only: properties that the camera must have, or it is refused by a ValueError, as the scene draws no other.
    """

    conditions: ClassVar[frozenset[str]] = CAMERA_CONDITIONS
    sun: tuple[float, float]
    haze: Colour | None = None
    only: ClassVar[Mapping[str, object]] = PLAIN
    world_first: ClassVar[bool] = False

    def __init__(self, camera: CameraSpec) -> None:
        for name, expected in self.only.items():
            if (value := getattr(camera, name)) != expected:
                raise ValueError(f"camera.{name} is {value}, expected {expected}: {type(self).__name__} draws no other")
        super().__init__(camera)
        self._run_spec, self._run_rows = camera, self._rows
        self._optics: Optics | None = None
        self._sensor: Sensor | None = None
        self._whole: Sensor | None = None
        """Without noise, for all rows."""

    @abstractmethod
    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        """Build the world of a road in place of the last one; `_run_spec` and `_run_rows` are those of the run."""

    @abstractmethod
    def _render(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        """Draw some rows of the world, (rows, columns, 3) uint8 RGB of the whole image; the others are zero.

        SimulatorError if no road is loaded, or if the renderer fails.
        """

    def load(self, road: Road, rng: np.random.Generator, conditions: Conditions = DEFAULT) -> None:
        """Build the world of a road from scratch; see `Scene.load`."""
        self._sensor = self._whole = None
        self._run_rows = self._rows
        lens_rng, world_rng = rng.spawn(2)
        if self.world_first:
            lens_rng, world_rng = world_rng, lens_rng
        self._run_spec, self._optics = camera_under(self._spec, conditions, lens_rng, sun=self.sun, haze=self.haze)
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
        return self._optics.apply(image, np.array(axes), position[2], rows)


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
        self._look, self.haze, self.sun = look, look.horizon, (look.sun_azimuth, look.sun_elevation)
        self._own_camera = self._camera = Camera(camera, look)
        self._memory: AtlasMemory | None = None
        self._ground: Ground | None = None

    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        self._ground = None
        self._memory = self._memory or (_SPARE.pop() if _SPARE else AtlasMemory())
        azimuth, elevation = conditions.sun_azimuth, conditions.sun_elevation
        look = replace(
            self._look,
            sun_azimuth=self.sun[0] if azimuth is None else azimuth,
            sun_elevation=self.sun[1] if elevation is None else elevation,
        )
        spec, rows = self._run_spec, scene_rows(self._run_spec, self._run_rows)
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

    def unload(self) -> None:
        """Forget the road, and leave the memory of its ground to whichever scene of this process loads one next."""
        if self._memory:
            _SPARE.append(self._memory)
        self.close()

    def close(self) -> None:
        """Release the painted ground."""
        super().close()
        self._ground = self._memory = None
