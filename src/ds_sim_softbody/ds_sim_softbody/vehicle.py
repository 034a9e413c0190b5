"""Soft-body car as a `ds_sim.parts.Vehicle`."""

from __future__ import annotations

import math

import numpy as np

from ds_sim.simulator import Command, SimulatorError, VehicleState
from ds_sim_softbody.car import Car
from ds_sim_softbody.lattice import blueprint
from ds_sim_softbody.parameters import SoftbodyParameters


class SoftbodyVehicle:
    """Car of nodes and beams on an infinite plane.

    The physics run in the car's axes at the start, so that a run does not depend on where it starts.

    Args:
        parameters: parameters of the car; nominal values if omitted.
    """

    def __init__(self, parameters: SoftbodyParameters | None = None) -> None:
        self._nominal = self._parameters = parameters or SoftbodyParameters()
        self._plan = blueprint(self._parameters)
        self._car: Car | None = None
        self._start = (0.0, 0.0, 0.0)

    @property
    def parameters(self) -> SoftbodyParameters:
        """Parameters of the car."""
        return self._parameters

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change grip and load for the runs to come; see `ds_sim.parts.AdjustableVehicle`."""
        parameters = self._nominal.adjusted(friction=friction, payload=payload)
        if parameters != self._parameters:
            self._parameters, self._plan = parameters, blueprint(parameters)

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build the car from scratch, at rest with its centre at (x, y), m, heading yaw (rad); `rng` is not used."""
        self._start = (x, y, yaw)
        self._car = Car(self._parameters, self._plan)

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held."""
        self._running().advance(command)

    def state(self) -> VehicleState:
        """State of the midpoint between the axles, of the undeformed frame fitted to the nodes."""
        car = self._running()
        motion = car.motion
        x, y, yaw = self._start
        cos, sin = math.cos(yaw), math.sin(yaw)
        own_cos, own_sin = math.cos(motion.yaw), math.sin(motion.yaw)
        return VehicleState(
            x=x + motion.x * cos - motion.y * sin,
            y=y + motion.x * sin + motion.y * cos,
            yaw=yaw + motion.yaw,
            speed=motion.velocity_x * own_cos + motion.velocity_y * own_sin,
            lateral_speed=motion.velocity_y * own_cos - motion.velocity_x * own_sin,
            yaw_rate=motion.yaw_rate,
            steering_angle=car.steering_angle(),
            roll=car.attitude.roll,
            pitch=car.attitude.pitch,
        )

    def close(self) -> None:
        """Release the frame; `reset` may follow."""
        self._car = None

    def _running(self) -> Car:
        if self._car is None:
            raise SimulatorError("the soft car has not been placed yet: call reset first")
        return self._car
