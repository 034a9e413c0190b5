# SPDX-License-Identifier: Apache-2.0
"""Linear single-track model integrated by SciPy: an oracle that shares no code with the vehicles.

Pacejka, Tire and Vehicle Dynamics, ch. 1.3 (two axles, small angles, constant speed) with the tyres of ch. 7 (slip
that builds up over the relaxation length). Left positive throughout, SI units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class Axle:
    """Both tyres of an axle.

    Attributes:
        distance: distance from the centre of mass, m.
        stiffness: lateral force over slip angle, N/rad; infinite for a tyre that does not slip.
        relaxation: length over which slip builds up, m.
        damping: time constant of the carcass, s.
        compliance: angle by which a lateral force turns the wheels, positive towards more force, rad/N.
    """

    distance: float
    stiffness: float = math.inf
    relaxation: float = 0.0
    damping: float = 0.0
    compliance: float = 0.0


@dataclass(frozen=True, kw_only=True)
class SingleTrack:
    """Car as two axles.

    Attributes:
        mass: kg.
        yaw_inertia: kg m^2.
        front: front axle.
        rear: rear axle.
        turning_resistance: yaw moment against the bend per lateral acceleration, kg m; it arises because the outer
            wheels carry more load and therefore have more rolling resistance.
        scale: road metres per metre of the model.
    """

    mass: float
    yaw_inertia: float
    front: Axle
    rear: Axle
    turning_resistance: float = 0.0
    scale: float = 1.0

    @property
    def wheelbase(self) -> float:
        """Wheelbase in metres of the model."""
        return self.front.distance + self.rear.distance

    @property
    def slips(self) -> bool:
        """True if the tyres slip."""
        return math.isfinite(self.front.stiffness)

    @property
    def understeer_gradient(self) -> float:
        """Steering angle per lateral acceleration, rad s^2/m (metres of the model): W_f / C_f - W_r / C_r.

        W is the share of the mass that an axle must accelerate sideways, including its share of the turning resistance.
        """
        if not self.slips:
            return 0.0
        front, rear = self.front, self.rear
        on_front = (self.mass * rear.distance + self.turning_resistance) / self.wheelbase
        on_rear = self.mass - on_front
        return on_front * (1.0 / front.stiffness - front.compliance) - on_rear * (
            1.0 / rear.stiffness - rear.compliance
        )

    def yaw_rate(
        self, speed: float, steering: Callable[[float], float], times: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Yaw rate at the times, (n,) rad/s, from straight ahead at time 0 s, for a steering angle over time (rad)."""
        if not self.slips:
            return np.array([speed * math.tan(steering(t)) / self.wheelbase for t in times])
        front, rear = self.front, self.rear

        def force(axle: Axle, slip: float, rate: float) -> float:
            return -axle.stiffness * (slip + axle.damping * rate)

        def slopes(time: float, s: NDArray[np.float64]) -> list[float]:
            v, r, slip_front, slip_rear, force_front, force_rear = s
            # The wheels follow the compliance instantly; a lag of 1 ms breaks the algebraic loop.
            turned_front = steering(time) + front.compliance * force_front
            turned_rear = rear.compliance * force_rear
            rate_front = (v + front.distance * r - speed * turned_front - speed * slip_front) / front.relaxation
            rate_rear = (v - rear.distance * r - speed * turned_rear - speed * slip_rear) / rear.relaxation
            now_front, now_rear = force(front, slip_front, rate_front), force(rear, slip_rear, rate_rear)
            lateral = (now_front + now_rear) / self.mass
            against = self.turning_resistance * lateral
            return [
                lateral - speed * r,
                (front.distance * now_front - rear.distance * now_rear - against) / self.yaw_inertia,
                rate_front,
                rate_rear,
                (now_front - force_front) / 1e-3,
                (now_rear - force_rear) / 1e-3,
            ]

        end = float(times[-1])
        found = solve_ivp(
            slopes, (0.0, end), np.zeros(6), method="LSODA", t_eval=times, rtol=1e-8, atol=1e-10, max_step=0.01
        )
        return np.asarray(found.y[1])
