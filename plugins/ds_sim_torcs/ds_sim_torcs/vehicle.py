# SPDX-License-Identifier: Apache-2.0
"""Car of TORCS as a `ds_sim.parts.Vehicle`: on an endless plane, from whose middle every run starts."""

from __future__ import annotations

import math
import struct

import numpy as np

from ds_sim.parts import VEHICLE_CONDITIONS, Vehicle
from ds_sim.simulator import Command, VehicleState
from ds_sim_torcs.host import Kind, TorcsHost
from ds_sim_torcs.parameters import CAR, SETTLING, SUBSTEPS, TorcsParameters

_PLACING = struct.Struct("<32s3f")
_PEDALS = struct.Struct("<I3fi")
_STATE = struct.Struct("<12d")
_AT_REST = (0.0,) * 12
FIRST_GEAR = 1


class TorcsVehicle(Vehicle):
    """Saloon with four-wheel drive in TORCS's own physics, simuv2.

    The host always starts at the origin of its plane and heads along +x, where single precision is finest, so a run is
    the same wherever a road lies; this class moves it to the road.

    Args:
        host: process with TORCS.
        parameters: parameters of the car; nominal values if omitted.
    """

    conditions = VEHICLE_CONDITIONS

    def __init__(self, host: TorcsHost, parameters: TorcsParameters | None = None) -> None:
        self._host = host
        self.nominal = self.parameters = parameters or TorcsParameters()
        self._start = (0.0, 0.0, 0.0)
        self._rest = self._now = _AT_REST
        self._yaw = 0.0

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change the car for the runs to come; see `Vehicle.adjust`."""
        self.parameters = self.nominal.adjusted(friction=friction, payload=payload)

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Place a new car at rest on its springs; `rng` is not used."""
        p = self.parameters
        self._host.start()
        self._start = (x, y, yaw)
        self._ask(Kind.CAR, _PLACING.pack(CAR.encode(), p.lock, p.mass, p.road_friction))
        self._drive(0.0, 0.0, p.brake_share, SETTLING)
        self._rest = self._now
        self._yaw = 0.0

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held."""
        p = self.parameters
        steer = p.inner_angle(-command.steering * p.max_steering_angle) / p.lock
        accelerator, brake = p.pedals(command.throttle, self._now[6])
        self._drive(steer, accelerator, brake, SUBSTEPS)
        self._yaw += math.remainder(self._now[3] - self._rest[3] - self._yaw, math.tau)  # counts full turns

    def state(self) -> VehicleState:
        """State of the midpoint between the axles, which is TORCS's centre of mass seen from above."""
        x, y, z, _, pitch, roll, forward, left, yaw_rate, right_wheel, left_wheel, _ = self._now
        start_x, start_y, start_yaw = self._start
        heading = start_yaw - self._rest[3]
        cos, sin = math.cos(heading), math.sin(heading)
        dx, dy = x - self._rest[0], y - self._rest[1]
        return VehicleState(
            x=start_x + dx * cos - dy * sin,
            y=start_y + dx * sin + dy * cos,
            yaw=start_yaw + self._yaw,
            speed=forward,
            lateral_speed=left,
            yaw_rate=yaw_rate,
            steering_angle=self.parameters.mean_angle(left_wheel, right_wheel),
            roll=roll - self._rest[5],
            pitch=pitch - self._rest[4],
            heave=z - self._rest[2],
        )

    def close(self) -> None:
        """End the host; `reset` may follow."""
        self._host.close()

    def _drive(self, steer: float, accelerator: float, brake: float, substeps: int) -> None:
        self._ask(Kind.STEP, _PEDALS.pack(substeps, steer, accelerator, brake, FIRST_GEAR))

    def _ask(self, kind: Kind, request: bytes) -> None:
        self._now = _STATE.unpack(self._host.ask(kind, request, size=_STATE.size))
