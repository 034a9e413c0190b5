# SPDX-License-Identifier: Apache-2.0
"""The multi-body car: what its authors publish in `commonroad-vehicle-models`, and all other constants, in SI units.

Equations and parameters are explained in Althoff, Wuersching: CommonRoad: Vehicle Models, 2020.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_sim.simulator import AutopilotGains

PACKAGE = "commonroad-vehicle-models"
VERSION = "3.0.2"
"""Version of the package whose functions `integration` compiles."""

STATES = 29
"""Length of the state."""
X, Y, STEERING, SPEED, YAW, YAW_RATE, ROLL, PITCH, LATERAL_SPEED, HEAVE = 0, 1, 2, 3, 4, 5, 6, 8, 10, 11
"""Sprung mass: position of its centre, velocity along its own axes, attitude (y left, but roll, pitch and z as in a
vehicle's axes with z down: roll left side down positive, pitch nose up positive, heave downwards)."""
FRONT_LATERAL_SPEED, REAR_LATERAL_SPEED = 15, 20
"""Lateral velocities of the axles."""
WHEEL_SPEEDS = 23
"""First of the four wheels' angular velocities: left front, right front, left rear, right rear."""
FRONT_OFFSET, REAR_OFFSET = 27, 28
"""Distance to the left of the axles by which the sprung mass has moved on their compliant joints."""
GRAVITY = 9.81
"""m/s^2; that of the published equations."""
PREVIEW_DISTANCE = 5.5
"""Distance of the autopilot's preview point, m; chosen with its gain."""
GAINS = AutopilotGains(proportional=0.15)
"""Chosen by driving the training roads, for the largest distance from the edge of the lane: a small gain and a far
preview suit a steering that needs 1.4 s from the middle to the angle of the sharpest bends."""


@dataclass(frozen=True, kw_only=True)
class MultiBodyParameters:
    """Parameters of the car: number of a published set, drive, and settings of the integration.

    The steering has the published limits of angle and rate: 0.4 rad/s suffices for the training roads. The published
    input is the acceleration that the drive asks for, turned into torques at the wheels; the tyres have no rolling
    resistance.
    """

    # Number of the published set; chosen: 1, a Ford Escort, a compact car with front-wheel drive, which neither the
    # siblings nor the twin have.
    parameter_set: int = 1
    # Side force of a tyre by its longitudinal slip, over its load (`r_vy1`). Published are -0.0278, of one tyre, for
    # all wheels, with which the car strays 0.8 m over 200 m of straight road; chosen: 0, as tyres on both sides of a
    # car mirror each other.
    slip_side_force: float = 0.0

    # Acceleration at full throttle, m/s^2; chosen: 0 to 20 km/h in 3 s under the paper's equation 2.
    drive_acceleration: float = 2.5
    max_speed: float = 30.0 / 3.6  # speed at which the limiter sets in, m/s; paper 4.2.4: 30 km/h
    # Speed range over which the limiter reduces the drive to zero, m/s; chosen: a tenth of the speed.
    limiter_band: float = 3.0 / 3.6
    # Deceleration without throttle, m/s^2; chosen: 0.2 g, that of Nissan's e-Pedal.
    regenerative_deceleration: float = 0.2 * GRAVITY
    fade_speed: float = 5.0 / 3.6  # speed below which that fades out, m/s; chosen: walking pace, 5 km/h
    # Throttle that neither drives nor brakes above the fade speed, 0 to 1; chosen: one-pedal maps use about the first
    # fifth for braking.
    neutral_throttle: float = 0.2

    substeps: int = 10  # least number of substeps per step of 1/20 s; chosen: 10, so that one takes at most 5 ms
    # Largest substep times the rate of the fastest tyre mode, which divides substeps the further the slower the car is;
    # chosen: 1.5, half of Runge-Kutta's limit of 2.79, as the load of a wheel can nearly double. Halving both moves the
    # car by at most 0.1 mm on a road.
    stable_step: float = 1.5

    @property
    def published(self) -> Any:
        """The published parameter set, with the package's own names."""
        return parameter_set(self.parameter_set)

    @property
    def wheelbase(self) -> float:
        """Distance of the axles, m; published."""
        return float(self.published.a + self.published.b)

    @property
    def max_steering_angle(self) -> float:
        """Angle of the front wheels for |steering| = 1, rad; published."""
        return float(self.published.steering.max)

    @property
    def centre_of_mass_ahead(self) -> float:
        """Distance of the centre of mass ahead of the midpoint between the axles, m."""
        return float(self.published.b - self.published.a) / 2.0

    @property
    def slip_rate(self) -> float:
        """Rate at which the fastest slip of a wheel decays, times speed, m/s^2.

        Along the wheel against its inertia, or sideways against the unsprung mass of its axle, under static load.
        """
        p = self.published
        wheelbase = p.a + p.b
        front, rear = p.m_s * p.b / wheelbase + p.m_uf, p.m_s * p.a / wheelbase + p.m_ur
        load = GRAVITY * max(front, rear) / 2.0
        along = p.tire.p_kx1 * p.R_w**2 / p.I_y_w
        sideways = 2.0 * abs(p.tire.p_ky1) / min(p.m_uf, p.m_ur)
        return float(load * max(along, sideways))


def check_version() -> None:
    """Refuse, by an ImportError, another version of the package than that which this project was tested with."""
    try:
        installed = metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        installed = "not installed"
    if installed != VERSION:
        raise ImportError(f"{PACKAGE} is {installed}, expected {VERSION}: pip install {PACKAGE}=={VERSION}")


@cache
def parameter_set(number: int) -> Any:
    """Read a published set, of a Ford Escort, BMW 320i or VW Vanagon (1 to 3), in SI units; do not change it."""
    from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

    return setup_vehicle_parameters(number)


def rest_state(number: int) -> NDArray[np.float64]:
    """State by the package's `init_mb`, (29,), at rest at the origin, before it has settled on its springs."""
    from vehiclemodels.init_mb import init_mb

    return np.array(init_mb([0.0] * 7, parameter_set(number)), dtype=np.float64)


def record(values: Any, **changed: Any) -> Any:
    """Copy the numbers of a dataclass, and of those inside it, to a NumPy record that compiled code can read.

    Fields that are None are left out; `changed` replaces fields, by a mapping in a dataclass inside.
    """
    numbers = dataclasses.asdict(values, dict_factory=_numbers)
    for name, value in changed.items():
        numbers[name] = {**numbers[name], **value} if isinstance(value, dict) else value
    return np.array(_row(numbers), dtype=_layout(numbers))[()]


def _numbers(fields: list[tuple[str, Any]]) -> dict[str, Any]:
    return {name: value for name, value in fields if value is not None and value != {}}


def _row(numbers: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(_row(v) if isinstance(v, dict) else float(v) for v in numbers.values())


def _layout(numbers: dict[str, Any]) -> np.dtype[np.void]:
    return np.dtype([(k, _layout(v) if isinstance(v, dict) else np.float64) for k, v in numbers.items()])
