# SPDX-License-Identifier: Apache-2.0
"""Wheels at their nodes, rack, motor, and the body's roll and pitch; the record of the car that compiled code advances.

The functions are compiled by `advance`, where their arguments are records with the fields of these classes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_sim.machine_code import layout
from ds_sim_softbody.lattice import NODES
from ds_sim_softbody.parameters import GRAVITY, SoftbodyParameters

MIN_LOAD_SHARE = 0.01
"""Smallest load of a wheel over its static load, even when lifted; chosen: small, but avoids divisions by zero."""


@dataclass(kw_only=True, slots=True)
class Wheel:
    """Wheel with a brush tyre on a flexible carcass (Pacejka, ch. 3 and 7).

    The carcass connects the contact patch to the wheel. Its deflection grows with the slip velocity and decays over
    the relaxation length, which yields the slip at any speed, including zero, without dividing by speed: a standing
    tyre is a spring with a damper. The brush formula converts the deflection to a force within the friction circle;
    beyond full sliding the deflection grows no further.
    """

    node: int  # node of the wheel
    fore: int  # node of the frame's bush ahead of its axis
    aft: int  # node of the frame's bush behind its axis
    static_load: float  # N
    cornering_stiffness: float  # cornering stiffness over load, 1/rad
    toe_per_shift: float  # angle by which the wheel turns left when it shifts left against its bushes, rad/m
    spin_inertia: float  # inertia about the axle, including what is geared to it, kg m^2
    rest: float = 0.0  # distance of the wheel to the left of the midpoint of its bushes without force, m
    torque: float = 0.0  # torque of the motor, N m
    spin: float = 0.0  # angular velocity about the axle, forward positive, rad/s
    load: float = 0.0  # vertical load, N
    along: float = 0.0  # deflection of the carcass along the wheel, m
    across: float = 0.0  # deflection of the carcass across the wheel, m
    stiffness_along: float = 0.0  # stiffness of the carcass under this load, N/m
    stiffness_across: float = 0.0  # the same, N/m
    grip: float = 0.0  # largest force of the tyre under this load, N
    resistance: float = 0.0  # moment of rolling resistance under this load, N m
    steering_cos: float = 1.0  # cosine of the steering angle
    steering_sin: float = 0.0  # sine of the steering angle
    heading_x: float = 1.0  # unit vector in the direction of the wheel
    heading_y: float = 0.0  # the same


def hypot(x: float, y: float) -> float:
    """Length of a vector that is not zero, in the bits of Python's `math.hypot`; the C library rounds otherwise."""
    long, short = max(abs(x), abs(y)), min(abs(x), abs(y))
    far, near = long * long, short * short
    length = math.sqrt(far + near)
    square = length * length
    rounding = _rounding(long, far) + _rounding(short, near) - _rounding(length, square)
    return length + (far - square + near + rounding) / (2.0 * length)


def _rounding(x: float, square: float) -> float:
    """Return x * x - square, what rounding took from a square, exactly (Dekker 1971)."""
    split = 134217729.0 * x
    high = split - (split - x)
    low = x - high
    return high * high - square + 2.0 * high * low + low * low


def turn(wheel: Wheel, angle: float) -> None:
    """Set the steering angle: that between frame and wheel with the arm unloaded, rad, left positive."""
    wheel.steering_cos, wheel.steering_sin = math.cos(angle), math.sin(angle)


def carry(wheel: Wheel, p: SoftbodyParameters, load: float) -> None:
    """Set the vertical load, N."""
    wheel.load = load = max(load, MIN_LOAD_SHARE * wheel.static_load)
    friction = p.friction * (1.0 - p.load_sensitivity * (load / wheel.static_load - 1.0))
    # Carcass stiffness that gives a force of C * slip in steady rolling: deflection = slip * relaxation length.
    wheel.stiffness_along = p.slip_stiffness * load / p.longitudinal_relaxation
    wheel.stiffness_across = wheel.cornering_stiffness * load / p.lateral_relaxation
    wheel.grip = max(friction, 0.1 * p.friction) * load
    wheel.resistance = p.rolling_resistance * load * p.wheel_radius


def shift(wheel: Wheel, nodes: NDArray[np.float64], ahead_x: float, ahead_y: float) -> float:
    """Distance of the wheel to the left of the midpoint of its bushes, m, seen along the unit vector between these."""
    at, fore, aft = nodes[wheel.node], nodes[wheel.fore], nodes[wheel.aft]
    return (at[1] - 0.5 * (fore[1] + aft[1])) * ahead_x - (at[0] - 0.5 * (fore[0] + aft[0])) * ahead_y


def roll(wheel: Wheel, p: SoftbodyParameters, nodes: NDArray[np.float64], dt: float) -> tuple[float, float]:
    """Advance the wheel by one substep dt (s) and return the force of the road on its node (x, y), N."""
    fore, aft = nodes[wheel.fore], nodes[wheel.aft]
    # Direction of the frame between the two bushes, rotated by the steering and by the flex of the arm.
    frame_x, frame_y = fore[0] - aft[0], fore[1] - aft[1]
    scale = 1.0 / math.sqrt(frame_x * frame_x + frame_y * frame_y)
    frame_x *= scale
    frame_y *= scale
    toe = wheel.toe_per_shift * (shift(wheel, nodes, frame_x, frame_y) - wheel.rest)
    cos, sin = wheel.steering_cos - toe * wheel.steering_sin, wheel.steering_sin + toe * wheel.steering_cos
    wheel.heading_x = ahead_x = frame_x * cos - frame_y * sin
    wheel.heading_y = ahead_y = frame_y * cos + frame_x * sin

    velocity_x, velocity_y = nodes[wheel.node, 2], nodes[wheel.node, 3]
    forward = velocity_x * ahead_x + velocity_y * ahead_y
    sideways = velocity_y * ahead_x - velocity_x * ahead_y
    tread = wheel.spin * p.wheel_radius
    rolled = abs(tread) * dt
    along = (wheel.along + (tread - forward) * dt) / (1.0 + rolled / p.longitudinal_relaxation)
    across = (wheel.across - sideways * dt) / (1.0 + rolled / p.lateral_relaxation)

    damping = p.carcass_damping / dt
    sliding = 3.0 * wheel.grip
    force_along = wheel.stiffness_along * (along + damping * (along - wheel.along))
    force_across = wheel.stiffness_across * (across + damping * (across - wheel.across))
    demanded_force = math.sqrt(force_along * force_along + force_across * force_across)
    share = demanded_force / sliding
    if share < 1.0:
        grip = 1.0 - share + share * share / 3.0
    else:
        grip = wheel.grip / demanded_force
        elastic_force = hypot(wheel.stiffness_along * along, wheel.stiffness_across * across)
        if elastic_force > sliding:
            along *= sliding / elastic_force
            across *= sliding / elastic_force
    wheel.along, wheel.across = along, across
    force_along *= grip
    force_across *= grip

    rolling = min(max(tread / p.rolling_threshold, -1.0), 1.0)
    wheel.spin += (wheel.torque - force_along * p.wheel_radius - wheel.resistance * rolling) * dt / wheel.spin_inertia
    return (
        force_along * ahead_x - force_across * ahead_y,
        force_along * ahead_y + force_across * ahead_x,
    )


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
