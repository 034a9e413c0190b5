"""The 1:16 car as a `ds_sim.vehicle.Vehicle`: model metres inside, road metres outside."""

from __future__ import annotations

import math

import numpy as np

from ds_sim.simulator import Command, VehicleState
from ds_twin_donkey.dynamics import CarModel, CarState, Pulse
from ds_twin_donkey.parameters import SCALE, DonkeyParameters


class DonkeyVehicle:
    """A Donkey Car on an endless floor.

    Args:
        parameters: of the car; the nominal ones if left out.
    """

    def __init__(self, parameters: DonkeyParameters | None = None) -> None:
        self._model = CarModel(parameters or DonkeyParameters())
        self._state = CarState()
        self._pulses: list[Pulse] = []
        self.reset(0.0, 0.0, 0.0, np.random.default_rng(0))

    @property
    def parameters(self) -> DonkeyParameters:
        """Of the car."""
        return self._model.parameters

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """At rest with its centre at (x, y) road metres; nothing of this car is drawn from `rng`."""
        ahead = self._centre_of_mass_ahead()
        self._state = CarState(x=x / SCALE + ahead * math.cos(yaw), y=y / SCALE + ahead * math.sin(yaw), yaw=yaw)
        self._pulses = [self._model.pulse(Command(0.0, 0.0))] * self._model.pulses_kept

    def advance(self, command: Command) -> None:
        """Hold a command for one frame of 1/20 s; it reaches the car after its delay."""
        self._pulses = [*self._pulses[1:], self._model.pulse(command)]
        self._state = self._model.advance(self._state, self._pulses)

    def state(self) -> VehicleState:
        """The state of the car's centre, in road metres."""
        s, ahead = self._state, self._centre_of_mass_ahead()
        return VehicleState(
            x=SCALE * (s.x - ahead * math.cos(s.yaw)),
            y=SCALE * (s.y - ahead * math.sin(s.yaw)),
            yaw=s.yaw,
            speed=SCALE * s.speed,
            lateral_speed=SCALE * (s.lateral_speed - ahead * s.yaw_rate),
            yaw_rate=s.yaw_rate,
            steering_angle=s.steering_angle,
            roll=s.roll,
            pitch=s.pitch,
        )

    def close(self) -> None:
        """Nothing to give back."""

    def _centre_of_mass_ahead(self) -> float:
        """How far the centre of mass lies ahead of the middle between the axles, model metres."""
        p = self.parameters
        return p.wheelbase * (p.front_share - 0.5)
