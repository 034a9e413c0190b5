# SPDX-License-Identifier: Apache-2.0
"""Base classes of the two parts of a simulator: a vehicle's physics, and the scene that its camera sees."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.simulator import Command, VehicleState

VEHICLE_CONDITIONS = frozenset({"friction", "payload"})
"""Conditions that `Vehicle.adjust` realises."""


class Vehicle(ABC):
    """Vehicle on an infinite flat plane, advanced step by step.

    Attributes:
        conditions: conditions that `adjust` realises, `VEHICLE_CONDITIONS` or none.
        delays_commands: whether the model has a dead time of its own, `command_delay`, which may be set.
        command_delay: dead time from a command to the actuators in the runs to come, s.
    """

    conditions: ClassVar[frozenset[str]] = frozenset()
    delays_commands: ClassVar[bool] = False
    command_delay: float = 0.0

    @abstractmethod
    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build the physics from scratch with the vehicle at rest.

        The states that follow depend on these arguments and on the commands alone, bit for bit, in any process.

        Args:
            x: position of the vehicle's centre, road metres.
            y: position of the vehicle's centre, road metres.
            yaw: heading, rad, counter-clockwise from +x.
            rng: source of all random numbers.
        """

    @abstractmethod
    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held; the model chooses its substeps."""

    @abstractmethod
    def state(self) -> VehicleState:
        """Current state in road metres, whatever the model's own scale."""

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change the vehicle for the runs to come; (1, 0) is the vehicle as it was made, bit for bit.

        Args:
            friction: factor on the tyres' grip on a dry road.
            payload: load over the mass of the vehicle, spread like that mass.
        """
        return

    def close(self) -> None:
        """Release the model's resources; `reset` may follow."""
        return


def check_ranges(parameters: Any, limits: Mapping[str, tuple[float, float]]) -> None:
    """Check the numbers of a dataclass by field: within limits, at least 0 where there are none, or ValueError."""
    for field in fields(parameters):
        value, (low, high) = getattr(parameters, field.name), limits.get(field.name, (0.0, math.inf))
        if not (math.isfinite(value) and low <= value <= high):
            raise ValueError(f"{field.name} is {value}, expected a number from {low:g} to {high:g}: correct it")


class Scene(ABC):
    """World of one road, as the camera of one vehicle sees it; images are (rows, columns, 3) uint8 RGB.

    Args:
        camera: camera and its mounting.

    Attributes:
        conditions: names of the conditions that it realises.
        drawing: whether images are drawn; otherwise they may be zero, and those that follow are the same.
    """

    conditions: ClassVar[frozenset[str]] = frozenset()

    def __init__(self, camera: CameraSpec) -> None:
        self.drawing = True
        self._spec = camera
        self._rows = (0, camera.height_px)
        """Rows to draw in the runs to come."""

    @abstractmethod
    def load(self, road: Road, rng: np.random.Generator, conditions: Conditions = DEFAULT) -> None:
        """Build the world of a road from scratch.

        The images that follow depend on these arguments and on the states alone, bit for bit, in any process.

        Args:
            road: a valid road.
            rng: source of all random numbers of the run, such as sensor noise.
            conditions: of the test, as `Conditions.for_scene` returns them.
        """

    @abstractmethod
    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Deliver the next camera image, read-only; called once a frame, as a sensor may have noise and latency."""

    @abstractmethod
    def still(self, state: VehicleState, rng: np.random.Generator | None = None) -> NDArray[np.uint8]:
        """Take one image from any pose in the loaded world, without latency; a run in progress is not affected.

        Args:
            state: pose and motion of the vehicle.
            rng: source of sensor noise; None for an image without noise, of which all rows are drawn.
        """

    def draw_rows(self, top: int, bottom: int) -> None:
        """Draw only some rows of the images of the runs to come; see `Simulator.draw_rows`."""
        if not 0 <= top < bottom <= self._spec.height_px:
            raise ValueError(
                f"rows {top} to {bottom} are no part of an image: expected 0 <= top < bottom <= {self._spec.height_px}"
            )
        self._rows = (top, bottom)

    def unload(self) -> None:
        """Forget the road once its run has ended, so that other scenes use its memory."""
        return

    def close(self) -> None:
        """Release the scene's resources; `load` may follow."""
        return
