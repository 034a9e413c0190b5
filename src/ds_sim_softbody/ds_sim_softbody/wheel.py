# SPDX-License-Identifier: Apache-2.0
"""Models a wheel at its node: heading, slip of the tyre, spin.

The functions are compiled by `advance`, where `p` and `wheel` are records with the fields of their classes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_sim_softbody.parameters import SoftbodyParameters

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
