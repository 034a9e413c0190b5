# SPDX-License-Identifier: Apache-2.0
"""World of a road as TORCS's renderer, ssggraph, draws it."""

from __future__ import annotations

import math
import struct
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.lens import optical_axes
from ds_sim.camera.optics import CAMERA_CONDITIONS
from ds_sim.camera.rendered_scene import RenderedScene
from ds_sim.camera.spec import CameraSpec, Colour, Look
from ds_sim.conditions.model import Conditions
from ds_sim.simulator import SimulatorError, VehicleState
from ds_sim_torcs.host import Kind, TorcsHost
from ds_sim_torcs.world import NAME, WORLD_CONDITIONS, write_world

_VIEW = struct.Struct("<18f2I")
LOOK = Look(
    # Chosen: old asphalt, weathered paint and the mean of TORCS's grass; sky and horizon are its panorama's.
    asphalt=(92, 92, 94),
    grass=(60, 105, 40),
    edge_line=(232, 232, 228),
    centre_line=(222, 168, 36),
    sky_top=(150, 190, 230),
    horizon=(205, 220, 235),
    line_width=0.15,
    sun_azimuth=math.radians(200.0),
    sun_elevation=math.radians(50.0),
)
"""Colours of the road; the sun's direction counts for `low_sun` alone, as the light comes from everywhere."""


class TorcsScene(RenderedScene):
    """Implements `ds_sim.parts.Scene` with TORCS's renderer: a road, grass, and TORCS's panorama.

    Args:
        host: process with TORCS.
        camera: pinhole camera of the host's image size.
        look: colours of the road.
    """

    conditions: ClassVar[frozenset[str]] = (
        WORLD_CONDITIONS | CAMERA_CONDITIONS | {"visibility", "sun_azimuth", "sun_elevation"}
    )
    haze: Colour | None = LOOK.horizon

    def __init__(self, host: TorcsHost, camera: CameraSpec, look: Look = LOOK) -> None:
        super().__init__(camera)
        self._host = host
        self._look, self.sun = look, (look.sun_azimuth, look.sun_elevation)
        self._origin: tuple[float, float] | None = None
        across = math.tan(camera.horizontal_fov / 2.0)
        down = math.degrees(2.0 * math.atan(across * camera.height_px / camera.width))
        self._fov = (math.degrees(camera.horizontal_fov), down)

    def close(self) -> None:
        """End the host; `load` may follow."""
        super().close()
        self._origin = None
        self._host.close()

    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        self._origin = None
        self._host.start()
        origin = write_world(self._host.folder, road, self._look, conditions)
        self._host.ask(Kind.ROAD, NAME.encode(), size=0)
        self._origin = origin

    def _render(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        if self._origin is None:
            raise SimulatorError("the scene has no road: load one first")
        spec = self._run_spec
        (right, down, forward), (x, y, z) = optical_axes(spec, state)
        matrix = (
            *right, 0.0, *forward, 0.0, *(-v for v in down), 0.0, x - self._origin[0], y - self._origin[1], z, 1.0,
        )  # fmt: skip
        top, bottom = rows
        size = (bottom - top) * spec.width * 3
        drawn = self._host.ask(Kind.VIEW, _VIEW.pack(*matrix, *self._fov, top, bottom), size=size)
        image = np.zeros((spec.height_px, spec.width, 3), np.uint8)
        image[top:bottom] = np.frombuffer(drawn, np.uint8).reshape(bottom - top, spec.width, 3)[::-1]
        return image
