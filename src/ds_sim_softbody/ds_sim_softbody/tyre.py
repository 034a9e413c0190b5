"""A tyre's forces from its slips: linear for small ones, limited by a friction circle, built up over a distance."""

from __future__ import annotations

import math

from ds_sim_softbody.parameters import SoftbodyParameters

_CREEP_SPEED = 0.5
"""m/s below which the contact patch also resists like a viscous one, so that a standing tyre does not swing."""
_CREEP_DAMPING = 6.0
"""Viscous force per load and m/s there; chosen: settles a standing wheel within a tenth of a second."""


class Tyre:
    """One wheel: its spin and the slips of its contact patch.

    Args:
        parameters: of the car.
        driven: whether the engine acts on it.
    """

    __slots__ = ("_alpha", "_kappa", "_p", "driven", "spin")

    def __init__(self, parameters: SoftbodyParameters, *, driven: bool) -> None:
        self._p = parameters
        self.driven = driven
        self.spin = 0.0
        self._kappa = 0.0
        self._alpha = 0.0

    def step(self, forward: float, left: float, load: float, torque: float, dt: float) -> tuple[float, float]:
        """Advance by dt seconds.

        Args:
            forward: speed of the hub in the wheel's plane, m/s.
            left: speed of the hub across it, m/s.
            load: on the contact patch, N.
            torque: of the engine, N m.
            dt: s.

        Returns:
            Force on the hub forward and to the left, N.
        """
        p = self._p
        rate = abs(forward) / p.relaxation
        share = dt / (1.0 + dt * rate)
        self._kappa += share * ((self.spin * p.tyre_radius - forward) / p.relaxation - rate * self._kappa)
        self._alpha += share * (-left / p.relaxation - rate * self._alpha)
        ahead, across = p.slip_stiffness * self._kappa, p.cornering_stiffness * self._alpha
        demand = math.hypot(ahead, across) / p.friction
        if demand > 1e-9:
            # Similar slip curves in every direction, so that the friction circle holds for combined slip.
            grip = math.tanh(demand) / demand
            if demand > 3.0:
                # A sliding tyre does not wind up further.
                self._kappa *= 3.0 / demand
                self._alpha *= 3.0 / demand
            ahead *= grip
            across *= grip
        if abs(forward) < _CREEP_SPEED:
            fade = 1.0 - abs(forward) / _CREEP_SPEED
            across -= fade * max(-p.friction, min(p.friction, _CREEP_DAMPING * left))
            ahead += fade * max(-p.friction, min(p.friction, _CREEP_DAMPING * (self.spin * p.tyre_radius - forward)))
        force = load * ahead
        rolling = p.rolling_resistance * load * p.tyre_radius * math.tanh(self.spin / 0.5)
        self.spin += dt * (torque - force * p.tyre_radius - rolling) / p.wheel_inertia
        return force, load * across
