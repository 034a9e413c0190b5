"""What a vehicle model is: the physics behind a simulator, knowing nothing of roads, cameras or outcomes."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ds_sim.simulator import Command, VehicleState


class Vehicle(Protocol):
    """A vehicle on an endless flat plane, advanced frame by frame."""

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build the physics anew with the vehicle at rest: its centre at (x, y) in road metres, heading yaw.

        The following states depend on these arguments and on the commands alone, bit for bit, in any process.
        """
        ...

    def advance(self, command: Command) -> None:
        """Hold a command for one frame of 1/20 s; the model chooses its substeps."""
        ...

    def state(self) -> VehicleState:
        """The state now, in road metres, whatever the model's own scale."""
        ...

    def close(self) -> None:
        """Give back what the model holds; `reset` may follow."""
        ...
