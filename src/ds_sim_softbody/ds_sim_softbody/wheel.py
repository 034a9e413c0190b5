"""Models a wheel at its node: heading, slip of the tyre, spin."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ds_sim_softbody.lattice import VALUES_PER_NODE, CornerNodes
from ds_sim_softbody.parameters import SoftbodyParameters

MIN_LOAD_SHARE = 0.01
"""Smallest load of a wheel over its static load, even when lifted; chosen: small, but avoids divisions by zero."""


@dataclass(frozen=True, kw_only=True)
class WheelPlan:
    """Properties of one wheel.

    Attributes:
        corner: nodes of the wheel and its bushes.
        static_load: N.
        cornering_stiffness: cornering stiffness over load, 1/rad.
        toe_per_shift: angle by which the wheel turns left when it shifts left against its bushes, rad/m.
        spin_inertia: inertia about the axle, including what is geared to it, kg m^2.
    """

    corner: CornerNodes
    static_load: float
    cornering_stiffness: float
    toe_per_shift: float
    spin_inertia: float


class Wheel:
    """Wheel with a brush tyre on a flexible carcass (Pacejka, ch. 3 and 7).

    The carcass connects the contact patch to the wheel. Its deflection grows with the slip velocity and decays over
    the relaxation length, which yields the slip at any speed, including zero, without dividing by speed: a standing
    tyre is a spring with a damper. The brush formula converts the deflection to a force within the friction circle;
    beyond full sliding the deflection grows no further.

    Args:
        p: parameters of the car.
        plan: properties of this wheel.
        nodes: nodes of the frame at rest, as returned by `Lattice.read`.
        dt: substep, s.
    """

    __slots__ = (
        "_across", "_aft", "_along", "_at", "_damping", "_dt", "_fore", "_heading_cos", "_heading_sin",
        "_inertia", "_lateral", "_limit", "_longitudinal", "_p", "_plan", "_radius", "_resistance",
        "_rest", "_threshold", "_toe", "heading_x", "heading_y", "load", "spin", "torque",
    )  # fmt: skip

    def __init__(self, p: SoftbodyParameters, plan: WheelPlan, nodes: list[float], *, dt: float) -> None:
        self._p, self._plan, self._dt = p, plan, dt
        self._at, self._fore, self._aft = (VALUES_PER_NODE * node for node in plan.corner)
        self._toe = plan.toe_per_shift
        self._inertia = plan.spin_inertia
        self._radius = p.wheel_radius
        self._threshold = p.rolling_threshold
        self._damping = p.carcass_damping / dt
        # Deflection of the carcass along and across the wheel, m.
        self._along = self._across = 0.0
        self.spin = 0.0
        """Angular velocity about the axle, forward positive, rad/s."""
        self.torque = 0.0
        """Torque of the motor, N m."""
        self.heading_x, self.heading_y = 1.0, 0.0
        """Unit vector in the direction of the wheel."""
        # Distance of the wheel to the left of the midpoint of its bushes, m.
        self._rest = nodes[self._at + 1] - 0.5 * (nodes[self._fore + 1] + nodes[self._aft + 1])
        self.turn(0.0)
        self.carry(plan.static_load)

    def turn(self, angle: float) -> None:
        """Set the steering angle: that between frame and wheel with the arm unloaded, rad, left positive."""
        self._heading_cos, self._heading_sin = math.cos(angle), math.sin(angle)

    def carry(self, load: float) -> None:
        """Set the vertical load, N."""
        p, plan = self._p, self._plan
        self.load = load = max(load, MIN_LOAD_SHARE * plan.static_load)
        grip = p.friction * (1.0 - p.load_sensitivity * (load / plan.static_load - 1.0))
        # Carcass stiffness that gives a force of C * slip in steady rolling: deflection = slip * relaxation length.
        self._longitudinal = p.slip_stiffness * load / p.longitudinal_relaxation
        self._lateral = plan.cornering_stiffness * load / p.lateral_relaxation
        self._limit = max(grip, 0.1 * p.friction) * load
        self._resistance = p.rolling_resistance * load * p.wheel_radius

    def roll(self, nodes: list[float]) -> tuple[float, float]:
        """Advance the wheel by one substep and return the force of the road on its node (x, y), N.

        Args:
            nodes: current nodes of the frame, as returned by `Lattice.read`.
        """
        at, fore, aft, dt = self._at, self._fore, self._aft, self._dt
        # Direction of the frame between the two bushes, rotated by the steering and by the flex of the arm.
        frame_x, frame_y = nodes[fore] - nodes[aft], nodes[fore + 1] - nodes[aft + 1]
        scale = 1.0 / math.sqrt(frame_x * frame_x + frame_y * frame_y)
        frame_x *= scale
        frame_y *= scale
        shift = (
            (nodes[at + 1] - 0.5 * (nodes[fore + 1] + nodes[aft + 1])) * frame_x
            - (nodes[at] - 0.5 * (nodes[fore] + nodes[aft])) * frame_y
            - self._rest
        )
        toe = self._toe * shift
        cos, sin = self._heading_cos - toe * self._heading_sin, self._heading_sin + toe * self._heading_cos
        self.heading_x = ahead_x = frame_x * cos - frame_y * sin
        self.heading_y = ahead_y = frame_y * cos + frame_x * sin

        velocity_x, velocity_y = nodes[at + 2], nodes[at + 3]
        forward = velocity_x * ahead_x + velocity_y * ahead_y
        sideways = velocity_y * ahead_x - velocity_x * ahead_y
        radius = self._radius
        tread = self.spin * radius
        rolled = abs(tread) * dt
        p = self._p
        along = (self._along + (tread - forward) * dt) / (1.0 + rolled / p.longitudinal_relaxation)
        across = (self._across - sideways * dt) / (1.0 + rolled / p.lateral_relaxation)

        sliding = 3.0 * self._limit
        force_along = self._longitudinal * (along + self._damping * (along - self._along))
        force_across = self._lateral * (across + self._damping * (across - self._across))
        demanded_force = math.sqrt(force_along * force_along + force_across * force_across)
        share = demanded_force / sliding
        if share < 1.0:
            grip = 1.0 - share + share * share / 3.0
        else:
            grip = self._limit / demanded_force
            elastic_force = math.hypot(self._longitudinal * along, self._lateral * across)
            if elastic_force > sliding:
                along *= sliding / elastic_force
                across *= sliding / elastic_force
        self._along, self._across = along, across
        force_along *= grip
        force_across *= grip

        rolling = tread / self._threshold
        rolling = 1.0 if rolling > 1.0 else -1.0 if rolling < -1.0 else rolling
        self.spin += (self.torque - force_along * radius - self._resistance * rolling) * dt / self._inertia
        return (
            force_along * ahead_x - force_across * ahead_y,
            force_along * ahead_y + force_across * ahead_x,
        )
