# SPDX-License-Identifier: Apache-2.0
"""Digital twin as a simulator: the 1:16 car in road metres, its wide-angle camera, the look of a taped floor."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.parts import VEHICLE_CONDITIONS, Vehicle
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_TIME, AutopilotGains, Command, SimulatorSpec, VehicleState
from ds_twin_donkey.car_files import read_parameters
from ds_twin_donkey.dynamics import SUBSTEPS, CarModel, CarState
from ds_twin_donkey.parameters import SCALE, DonkeyParameters

PREVIEW_DISTANCE = 4.0
"""Distance of the autopilot's preview point, road metres; chosen: about 0.6 s at 25 km/h, which covers the delays of
command and servo, and the play."""
GAINS = AutopilotGains(proportional=0.4)
"""Chosen by driving random roads; the preview replaces the derivative term."""
CAMERA = CameraSpec(
    # The Donkey Car's wide-angle Pi camera: sold as 160 degrees over the diagonal, about 120 across.
    horizontal_fov=math.radians(120.0),
    # On the roll cage, 0.12 m above the floor and 0.04 m ahead of the car's centre.
    height=0.12 * SCALE,
    forward=0.04 * SCALE,
    pitch=math.radians(12.0),
    lens="equidistant",
    # Chosen as docs/cameras.md explains, to match brightness, noise and noise spectrum of photographs from such a car.
    gain=1.08,
    gamma=1.15,
    noise=1.6,
    noise_blur=2.8,
    noise_colour=0.5,
    # Chosen: automatic exposure indoors, between the 50 ms of a frame and the 1/60 s that avoids lamp flicker.
    exposure=1.0 / 60.0,
    # One 50 ms frame: exposure, readout and transfer of a Pi camera take 40 to 100 ms.
    latency=1,
)
LOOK = Look(
    asphalt=(84, 84, 92),
    grass=(86, 116, 62),
    edge_line=(238, 238, 232),
    centre_line=(232, 182, 28),
    sky_top=(66, 70, 74),
    horizon=(150, 150, 146),
    sky_height=20.0,
    # Tape 12 mm wide.
    line_width=0.012 * SCALE,
    asphalt_grain=4.0,
    grass_grain=10.0,
    grain_seed=16,
    # Chosen: a hall as in the photographs, with furniture in front of pale walls and lamps under a dark ceiling.
    hills=13.0,
    hill_colour=(164, 162, 154),
    skyline="room",
    lamps=90,
)


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


class DonkeySimulator(RoadSimulator):
    """Simulator of a 1:16 Donkey Car on a 1:16 road, reported in road metres; its spec shows the parameters' source."""

    def __init__(self, parameters: DonkeyParameters | None = None, source: str = "nominal") -> None:
        parameters = parameters or DonkeyParameters()
        spec = SimulatorSpec(
            name="donkey",
            physics="1:16 car on four slipping tyres, with its servo, speed controller, motor and delays",
            # The chassis is 0.28 m long and 0.18 m wide.
            vehicle_length=0.28 * SCALE,
            vehicle_width=0.18 * SCALE,
            wheelbase=parameters.wheelbase * SCALE,
            max_steering_angle=parameters.max_steering_angle,
            camera=CAMERA,
            look=LOOK,
            crop_top=40,
            crop_bottom=0,
            autopilot=GAINS,
            preview_distance=PREVIEW_DISTANCE,
            engine=f"own four-wheel model, Runge-Kutta at {SUBSTEPS / FRAME_TIME:g} Hz",
            extra={
                "scale": f"1:{SCALE:g}",
                "car": source,
                "command_delay": f"{1000 * parameters.command_delay:.0f} ms",
                "camera_latency": f"{CAMERA.latency} frame",
            },
        )
        super().__init__(spec, DonkeyVehicle(parameters))

    @classmethod
    def from_file(cls, path: Path) -> DonkeySimulator:
        """Make the simulator with a file of `ds twin fit`; ParameterFileError if it cannot be used."""
        parameters, digest = read_parameters(path)
        return cls(parameters, f"{path.name} sha256 {digest}")
