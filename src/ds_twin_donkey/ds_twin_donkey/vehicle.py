# SPDX-License-Identifier: Apache-2.0
"""1:16 car as a `ds_sim.parts.Vehicle`: converts between model metres and road metres."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ds_sim.parts import VEHICLE_CONDITIONS, Vehicle
from ds_sim.simulator import Command, VehicleState
from ds_twin_donkey.dynamics import CarModel, CarState
from ds_twin_donkey.parameters import SCALE, DonkeyParameters


class DonkeyVehicle(Vehicle):
    """Donkey Car on an infinite floor, with nominal parameters unless others are given."""

    conditions = VEHICLE_CONDITIONS
    delays_commands = True

    def __init__(self, parameters: DonkeyParameters | None = None) -> None:
        self._nominal = parameters or DonkeyParameters()
        self._model = CarModel(self._nominal)
        self.reset(0.0, 0.0, 0.0, np.random.default_rng(0))

    @property
    def parameters(self) -> DonkeyParameters:
        """Parameters of the car."""
        return self._model.parameters

    @property
    def command_delay(self) -> float:
        """Dead time from a command to its pulse, s; setting it changes the runs to come."""
        return self._nominal.command_delay

    @command_delay.setter
    def command_delay(self, seconds: float) -> None:
        self._nominal = replace(self._nominal, command_delay=seconds)

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change grip and load for the runs to come; see `Vehicle.adjust`."""
        parameters = self._nominal.adjusted(friction=friction, payload=payload)
        if parameters != self._model.parameters:
            self._model = CarModel(parameters)

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Put the car at rest with its centre at (x, y), road metres, heading yaw (rad); `rng` is not used."""
        ahead = self._centre_of_mass_ahead()
        self._state = CarState(x=x / SCALE + ahead * math.cos(yaw), y=y / SCALE + ahead * math.sin(yaw), yaw=yaw)
        self._commands = [(0.0, 0.0)] * self._model.frames_kept

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held; it reaches the car after the command delay."""
        self._commands = [*self._commands[1:], (command.steering, command.throttle)]
        self._state = CarState(*self._model.run(self._state, self._commands)[1].tolist())

    def state(self) -> VehicleState:
        """State of the car's centre, in road metres."""
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

    def _centre_of_mass_ahead(self) -> float:
        """Distance of the centre of mass ahead of the midpoint between the axles, model metres."""
        p = self.parameters
        return p.wheelbase * (p.front_share - 0.5)
