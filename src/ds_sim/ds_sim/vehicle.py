"""Interface of vehicle models: the physics of a simulator, independent of roads, cameras and outcomes."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

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


VEHICLE_CONDITIONS = frozenset({"friction", "payload"})
"""Conditions that an `AdjustableVehicle` realises."""
