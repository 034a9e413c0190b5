# SPDX-License-Identifier: Apache-2.0
"""Published multi-body model as a `ds_sim.parts.Vehicle`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ds_sim.parts import VEHICLE_CONDITIONS, Vehicle
from ds_sim.simulator import FRAME_TIME, Command, SimulatorError, VehicleState
from ds_sim_panda.vehicle import parameters as model
from ds_sim_panda.vehicle.parameters import MultiBodyParameters

SETTLING_FRAMES = 200
"""Frames at rest in which the car settles on its springs; chosen: 10 s, fifteen periods of the body."""


class MultiBodyVehicle(Vehicle):
    """Car with 29 states on an infinite plane.

    The model runs in the car's axes at the start, so that a run does not depend on where it starts.
    """

    conditions = VEHICLE_CONDITIONS

    def __init__(self, parameters: MultiBodyParameters | None = None) -> None:
        model.check_version()
        from ds_sim_panda.vehicle.integration import advance  # imports Numba, which takes most of a second

        self.parameters = parameters or MultiBodyParameters()
        self._integrate = advance
        self._adjusted = (1.0, 0.0)
        self._settle()
        self._x: np.ndarray | None = None
        self._start = (0.0, 0.0, 0.0)

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change grip and load for the runs to come; see `Vehicle.adjust`."""
        if (friction, payload) != self._adjusted:
            self._adjusted = (friction, payload)
            self._settle()

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Place the car at rest with its centre at (x, y), m, heading yaw (rad); `rng` is not used."""
        self._start = (x, y, yaw)
        self._x = self._rest.copy()
        self._x[model.X] = self.parameters.centre_of_mass_ahead

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held."""
        self._advance(self._running(), command)

    def state(self) -> VehicleState:
        """State of the midpoint between the axles."""
        s = self._running()
        ahead = self.parameters.centre_of_mass_ahead
        yaw = float(s[model.YAW])
        cos, sin = math.cos(yaw), math.sin(yaw)
        # The axles' midpoint in the axes at the start: the sprung mass leans over it on compliant joints.
        offset = 0.5 * (s[model.FRONT_OFFSET] + s[model.REAR_OFFSET])
        x = float(s[model.X] - ahead * cos + offset * sin)
        y = float(s[model.Y] - ahead * sin - offset * cos)
        start_x, start_y, start_yaw = self._start
        start_cos, start_sin = math.cos(start_yaw), math.sin(start_yaw)
        pitch = float(self._rest[model.PITCH] - s[model.PITCH])
        return VehicleState(
            x=start_x + x * start_cos - y * start_sin,
            y=start_y + x * start_sin + y * start_cos,
            yaw=start_yaw + yaw,
            speed=float(s[model.SPEED]),
            lateral_speed=0.5 * float(s[model.FRONT_LATERAL_SPEED] + s[model.REAR_LATERAL_SPEED]),
            yaw_rate=float(s[model.YAW_RATE]),
            steering_angle=float(s[model.STEERING]),
            roll=-float(s[model.ROLL]),
            pitch=pitch,
            heave=float(self._rest[model.HEAVE] - s[model.HEAVE]) + ahead * math.sin(pitch),
        )

    def close(self) -> None:
        """Release the state; `reset` may follow."""
        self._x = None

    def _settle(self) -> None:
        """Make the car with its grip and load, at rest on its springs."""
        p, (friction, payload) = self.parameters, self._adjusted
        car, grown = p.published, 1.0 + payload
        tyre = {"r_vy1": p.slip_side_force}
        changed: dict[str, Any] = {}
        if friction != 1.0:
            # Peak friction of the Magic Formula; its stiffness, and so the feel below the limit, stays.
            tyre |= {"p_dx1": friction * car.tire.p_dx1, "p_dy1": friction * car.tire.p_dy1}
        if payload:
            sprung = (car.m_s + payload * car.m) / car.m_s
            changed = {"m": grown * car.m, "m_s": sprung * car.m_s, "I_z": grown * car.I_z}
            changed |= {name: sprung * getattr(car, name) for name in ("I_Phi_s", "I_y_s", "I_xz_s")}
        self._car: Any = model.record(car, tire=tyre, **changed)
        # The published input is an acceleration: the motor's force stays that of the car without load.
        self._law: Any = model.record(
            p,
            slip_rate=p.slip_rate * grown,
            drive_acceleration=p.drive_acceleration / grown,
            regenerative_deceleration=p.regenerative_deceleration / grown,
        )
        self._rest = model.rest_state(p.parameter_set)
        for _ in range(SETTLING_FRAMES):
            self._advance(self._rest, Command(0.0, 0.0))

    def _advance(self, state: np.ndarray, command: Command) -> None:
        p = self.parameters
        # The sign of the command is that of the paper, right positive.
        self._integrate(
            state,
            -float(command.steering) * p.max_steering_angle,
            float(command.throttle),
            FRAME_TIME,
            p.substeps,
            self._car,
            self._law,
        )

    def _running(self) -> np.ndarray:
        if self._x is None:
            raise SimulatorError("the multi-body car has not been placed yet: call reset first")
        return self._x
