# SPDX-License-Identifier: Apache-2.0
"""Rack, motor, and the body's roll and pitch, and the record of the whole car that compiled code advances.

The functions are compiled by `advance`, where their arguments are records with the fields of these classes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ds_sim.machine_code import layout
from ds_sim_softbody.lattice import NODES
from ds_sim_softbody.parameters import GRAVITY, SoftbodyParameters
from ds_sim_softbody.wheel import Wheel


@dataclass(kw_only=True, slots=True)
class Actuators:
    """Steering rack with a limited rate; electric motor that drives the rear axle through an open differential."""

    angle: float = 0.0  # mean angle of the front wheels set by the rack, rad, left positive
    torque: float = 0.0  # torque at each of the two rear wheels, N m


def steer(actuators: Actuators, p: SoftbodyParameters, steering: float, dt: float) -> tuple[float, float]:
    """Move the rack towards a command (right positive) for dt (s); returns the angles of the left and right wheel.

    The angles are in rad, left positive.
    """
    # The sign of the command is that of the paper, right positive.
    target = -steering * p.max_steering_angle
    step = p.steering_rate * dt
    actuators.angle += min(max(target - actuators.angle, -step), step)
    tangent = math.tan(actuators.angle)
    narrow = p.ackermann * tangent * p.track / (2.0 * p.wheelbase)
    return math.atan2(tangent, 1.0 - narrow), math.atan2(tangent, 1.0 + narrow)


def drive(actuators: Actuators, p: SoftbodyParameters, throttle: float, wheel_speed: float, dt: float) -> float:
    """Follow the one-pedal map for dt, s, at a tread speed, m/s; returns the torque at each rear wheel, N m."""
    generating = min(max(wheel_speed / p.fade_speed, -1.0), 1.0)
    force = p.drive_force if p.drive_force * wheel_speed < p.power else p.power / wheel_speed
    force *= min(max(p.top_speed - wheel_speed, 0.0), 1.0)
    force = force * throttle - p.regenerative_force * generating * (1.0 - throttle)
    gain = p.wheel_radius / 2.0
    actuators.torque += (force * gain - actuators.torque) * (1.0 - math.exp(-dt / p.motor_lag))
    return actuators.torque


@dataclass(kw_only=True, slots=True)
class Attitude:
    """Roll and pitch as two damped oscillators, excited by the acceleration of the body (Gillespie, ch. 6).

    Load that springs and dampers do not carry reaches the wheels instantly, through the arms and the unsprung masses;
    in steady state the loads are those of the whole mass at the height of its centre.
    """

    roll_lever: float  # sprung mass times its height above the roll axis, kg m
    roll_stiffness: float  # N m/rad
    roll_damping: float  # N m s/rad
    pitch_lever: float  # sprung mass times its height, kg m
    pitch_stiffness: float  # N m/rad
    pitch_damping: float  # N m s/rad
    roll: float = 0.0  # rad
    roll_rate: float = 0.0  # rad/s
    pitch: float = 0.0  # rad
    pitch_rate: float = 0.0  # rad/s

    @classmethod
    def at_rest(cls, p: SoftbodyParameters) -> Attitude:
        """Body of a car at rest."""
        spring = p.sprung_mass * (math.tau * p.ride_frequency) ** 2
        roll_lever = p.sprung_mass * (p.centre_of_mass_height - p.roll_axis_height)
        # Net of gravity, which increases the lean: gradient = lever / stiffness.
        net_roll = roll_lever / p.roll_gradient
        pitch_lever = p.sprung_mass * p.centre_of_mass_height
        pitch_stiffness = spring * (p.wheelbase / 2.0) ** 2
        net_pitch = pitch_stiffness - pitch_lever * GRAVITY
        return cls(
            roll_lever=roll_lever,
            roll_stiffness=net_roll + roll_lever * GRAVITY,
            roll_damping=2.0 * p.body_damping * math.sqrt(net_roll * p.roll_inertia),
            pitch_lever=pitch_lever,
            pitch_stiffness=pitch_stiffness,
            pitch_damping=2.0 * p.body_damping * math.sqrt(net_pitch * p.pitch_inertia),
        )


def lean(attitude: Attitude, p: SoftbodyParameters, forward: float, left: float, dt: float) -> None:
    """Advance the body by dt (s) under its acceleration (forward and left, m/s^2)."""
    a = attitude
    roll_moment = a.roll_lever * (left + GRAVITY * math.sin(a.roll)) - roll_reaction(a)
    pitch_moment = a.pitch_lever * (GRAVITY * math.sin(a.pitch) - forward) - pitch_reaction(a)
    a.roll_rate += roll_moment / p.roll_inertia * dt
    a.pitch_rate += pitch_moment / p.pitch_inertia * dt
    a.roll += a.roll_rate * dt
    a.pitch += a.pitch_rate * dt


def loads(attitude: Attitude, p: SoftbodyParameters, forward: float, left: float) -> tuple[float, float, float, float]:
    """Wheel loads under an acceleration of the body (m/s^2), N: front left, front right, rear left, rear right.

    A negative load means that the wheel is in the air.
    """
    total = p.mass * p.centre_of_mass_height
    direct = (total - attitude.roll_lever) * left
    moment = roll_reaction(attitude)
    front = (moment * p.roll_front_share + direct * p.front_share) / p.track
    rear = (moment * (1.0 - p.roll_front_share) + direct * (1.0 - p.front_share)) / p.track
    dive = (pitch_reaction(attitude) - (total - attitude.pitch_lever) * forward) / p.wheelbase
    front_half = (p.mass * GRAVITY * p.front_share + dive) / 2.0
    rear_half = (p.mass * GRAVITY * (1.0 - p.front_share) - dive) / 2.0
    return front_half - front, front_half + front, rear_half - rear, rear_half + rear


def roll_reaction(attitude: Attitude) -> float:
    """Restoring moment of springs and dampers in roll, N m."""
    return attitude.roll_stiffness * attitude.roll + attitude.roll_damping * attitude.roll_rate


def pitch_reaction(attitude: Attitude) -> float:
    """Restoring moment of springs and dampers in pitch, N m."""
    return attitude.pitch_stiffness * attitude.pitch + attitude.pitch_damping * attitude.pitch_rate


CAR = np.dtype(
    [
        ("parameters", layout(SoftbodyParameters)),
        ("actuators", layout(Actuators)),
        ("attitude", layout(Attitude)),
        ("wheels", layout(Wheel), (4,)),
        ("nodes", np.float64, (NODES, 4)),
        ("space", np.intp),
        ("each_body", np.intp),
        ("request", np.intp),
        ("bodies", np.intp, (4,)),
    ]
)
"""Record of a car: wheels and their bodies front left, front right, rear left, rear right; the rest as in `Lattice`."""
