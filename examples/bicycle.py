# SPDX-License-Identifier: Apache-2.0
"""Example of a fourth simulator: a kinematic bicycle, which never slides. `docs/add_a_simulator.md` explains it."""

from __future__ import annotations

import math

import numpy as np

from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.parts import Vehicle
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_TIME, AutopilotGains, Command, SimulatorSpec, VehicleState

WHEELBASE = 2.6
"""m; chosen: a compact car."""
MAX_STEERING = math.radians(32.0)
"""Chosen: turns on a circle of about 5 m, less than the radius of any lane."""
STEERING_LAG = 0.1
"""s; chosen: the wheels follow the command as a first-order lag."""
MAX_ACCELERATION = 3.0
"""m/s2 at full throttle; chosen: a small car."""
DRAG = 0.3
"""1/s; chosen: the top speed is 36 km/h, and the car slows down without throttle."""
SUBSTEPS = 10
"""Chosen: 5 ms, a twentieth of the steering lag."""


class BicycleVehicle(Vehicle):
    """Two wheels in line that roll where they point; the vehicle's centre is midway between them."""

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Put the vehicle at rest; `rng` is not used."""
        self._x, self._y, self._yaw, self._speed, self._angle = x, y, yaw, 0.0, 0.0

    def advance(self, command: Command) -> None:
        """Advance by one step. Steering commands are right positive, wheel angles left positive."""
        dt = FRAME_TIME / SUBSTEPS
        for _ in range(SUBSTEPS):
            self._angle += (-command.steering * MAX_STEERING - self._angle) * dt / STEERING_LAG
            self._speed += (command.throttle * MAX_ACCELERATION - DRAG * self._speed) * dt
            slip = self._slip()
            self._x += self._speed * math.cos(self._yaw + slip) * dt
            self._y += self._speed * math.sin(self._yaw + slip) * dt
            self._yaw += self._yaw_rate() * dt

    def state(self) -> VehicleState:
        """Current state; this car neither rolls nor pitches."""
        slip = self._slip()
        return VehicleState(
            x=self._x,
            y=self._y,
            yaw=self._yaw,
            speed=self._speed * math.cos(slip),
            lateral_speed=self._speed * math.sin(slip),
            yaw_rate=self._yaw_rate(),
            steering_angle=self._angle,
        )

    def _slip(self) -> float:
        """Angle from the heading to the direction of motion of the centre, rad."""
        return math.atan(0.5 * math.tan(self._angle))

    def _yaw_rate(self) -> float:
        return self._speed * math.cos(self._slip()) * math.tan(self._angle) / WHEELBASE


class BicycleSimulator(RoadSimulator):
    """Simulator of the bicycle: adds a camera, a look and gains for the autopilot."""

    def __init__(self) -> None:
        spec = SimulatorSpec(
            name="bicycle",
            physics="kinematic bicycle: rolls where its wheels point",
            vehicle_length=3.8,
            vehicle_width=1.7,
            wheelbase=WHEELBASE,
            max_steering_angle=MAX_STEERING,
            camera=CameraSpec(horizontal_fov=math.radians(95.0), height=1.3, forward=0.4, pitch=math.radians(8.0)),
            look=Look(asphalt=(105, 103, 100), grass=(110, 140, 70), grain_seed=4),
            crop_top=60,
            crop_bottom=0,
            autopilot=AutopilotGains(proportional=0.5),
            preview_distance=3.0,
        )
        super().__init__(spec, BicycleVehicle())
