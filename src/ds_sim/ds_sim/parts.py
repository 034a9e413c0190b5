# SPDX-License-Identifier: Apache-2.0
"""Interfaces of the two parts of a simulator: a vehicle's physics, and the scene that its camera sees."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.simulator import Command, VehicleState


class Vehicle(Protocol):
    """Vehicle on an infinite flat plane, advanced step by step."""

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build the physics from scratch with the vehicle at rest.

        The states that follow depend on these arguments and on the commands alone, bit for bit, in any process.

        Args:
            x: position of the vehicle's centre, road metres.
            y: position of the vehicle's centre, road metres.
            yaw: heading, rad, counter-clockwise from +x.
            rng: source of all random numbers.
        """
        ...

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held; the model chooses its substeps."""
        ...

    def state(self) -> VehicleState:
        """Current state in road metres, whatever the model's own scale."""
        ...

    def close(self) -> None:
        """Release the model's resources; `reset` may follow."""
        ...


@runtime_checkable
class AdjustableVehicle(Protocol):
    """Vehicle whose physics take conditions of a test; any other has the default ones."""

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change the vehicle for the runs to come; (1, 0) is the vehicle as it was made, bit for bit.

        Args:
            friction: factor on the tyres' grip on a dry road.
            payload: load over the mass of the vehicle, spread like that mass.
        """
        ...


@runtime_checkable
class DelayedVehicle(Protocol):
    """Vehicle with a dead time of its own from a command to its actuators; any other has none.

    Attributes:
        command_delay: the dead time of the runs to come, s; it may be set.
    """

    command_delay: float


def check_ranges(
    parameters: Any, limits: Mapping[str, tuple[float, float]], usual: tuple[float, float] = (0.0, math.inf)
) -> None:
    """Check the numbers of a dataclass of a vehicle's parameters.

    Args:
        parameters: the dataclass.
        limits: smallest and largest value by name of the field.
        usual: the same for all other fields.

    Raises:
        ValueError: a value is not finite or out of range.
    """
    for field in fields(parameters):
        value, (low, high) = getattr(parameters, field.name), limits.get(field.name, usual)
        if not (math.isfinite(value) and low <= value <= high):
            raise ValueError(f"{field.name} is {value}, expected a number from {low:g} to {high:g}: correct it")


VEHICLE_CONDITIONS = frozenset({"friction", "payload"})
"""Conditions that an `AdjustableVehicle` realises."""


class Scene(Protocol):
    """World of one road, as the camera of one vehicle sees it; images are (rows, columns, 3) uint8 RGB."""

    @property
    def conditions(self) -> frozenset[str]:
        """Names of the conditions that it realises."""
        ...

    def load(self, road: Road, rng: np.random.Generator, conditions: Conditions = DEFAULT) -> None:
        """Build the world of a road from scratch.

        The images that follow depend on these arguments and on the states alone, bit for bit, in any process.

        Args:
            road: a valid road.
            rng: source of all random numbers of the run, such as sensor noise.
            conditions: of the test, as `Conditions.for_scene` returns them.
        """
        ...

    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Deliver the next camera image, read-only; called once a frame, as a sensor may have noise and latency."""
        ...

    def still(self, state: VehicleState, rng: np.random.Generator | None = None) -> NDArray[np.uint8]:
        """Take one image from any pose in the loaded world, without latency; a run in progress is not affected.

        Args:
            state: pose and motion of the vehicle.
            rng: source of sensor noise; None for an image without noise, of which all rows are drawn.
        """
        ...

    def draw_rows(self, top: int, bottom: int) -> None:
        """Draw only some rows of the images of the runs to come; see `DrawsRows.draw_rows`."""
        ...

    def close(self) -> None:
        """Release the scene's resources; `load` may follow."""
        ...


def check_rows(top: int, bottom: int, camera: CameraSpec) -> None:
    """Check that `Scene.draw_rows` names rows of a camera's image.

    Raises:
        ValueError: it does not.
    """
    if not 0 <= top < bottom <= camera.height_px:
        raise ValueError(
            f"rows {top} to {bottom} are no part of an image: expected 0 <= top < bottom <= {camera.height_px}"
        )
