# SPDX-License-Identifier: Apache-2.0
"""The bicycle model of a vehicle: wheel angles for yaw rates, curvatures and points ahead.

Sources: Rajamani, Vehicle Dynamics and Control, 2012, section 2.2; pure pursuit: Coulter, Implementation of the Pure
Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01, 1992; frames: REP-103.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_sim.simulator import SimulatorSpec

STANDSTILL = 1e-3
"""Commanded speed below which a yaw rate does not determine the wheel angle, m/s: a car cannot turn on the spot."""


class MotionError(InputError):
    """A request that no vehicle of this project can follow."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """Geometry of a vehicle: its wheelbase, m, and the angle of the front wheels at |steering| = 1, rad."""

    wheelbase: float
    max_steering_angle: float

    def __post_init__(self) -> None:
        if not (self.wheelbase > 0.0 and 0.0 < self.max_steering_angle < math.pi / 2):
            raise MotionError(
                f"wheelbase {self.wheelbase} m and steering angle {self.max_steering_angle} rad: expected a wheelbase "
                "above 0 and an angle between 0 and pi/2"
            )

    @classmethod
    def of(cls, spec: SimulatorSpec) -> Geometry:
        """Return the geometry of a simulator's vehicle, in road metres."""
        return cls(spec.wheelbase, spec.max_steering_angle)

    def steering_of(self, angle: float) -> float:
        """Steering in [-1, 1], right positive, for a wheel angle in rad, left positive; clipped at full lock."""
        return min(max(-angle / self.max_steering_angle, -1.0), 1.0)

    def angle_of(self, steering: float) -> float:
        """Wheel angle in rad, left positive, for a steering in [-1, 1], right positive."""
        return -steering * self.max_steering_angle

    def angle_for(self, speed: float, yaw_rate: float) -> float:
        """Wheel angle (rad, left positive) at which the bicycle model has a yaw rate (rad/s) at a speed (m/s)."""
        return 0.0 if abs(speed) < STANDSTILL else math.atan(self.wheelbase * yaw_rate / speed)

    def yaw_rate_of(self, speed: float, angle: float) -> float:
        """Yaw rate of the bicycle model, rad/s, left positive, at a speed (m/s) and wheel angle (rad)."""
        return speed * math.tan(angle) / self.wheelbase

    def angle_of_curvature(self, curvature: float) -> float:
        """Wheel angle (rad, left positive) that follows an arc of a curvature in 1/m, left positive."""
        return math.atan(self.wheelbase * curvature)


def pursuit_curvature(path: NDArray[np.float64], lookahead: float) -> float:
    """Curvature of the arc from the rear axle to a path's first point at a distance, `lookahead` in m: pure pursuit.

    The path is (n, 2) points, m ahead and to the left of the middle of the rear axle; a shorter one is pursued to its
    end. The curvature is in 1/m, left positive; 0 for a point on the axle itself.
    """
    points = [(float(ahead), float(left)) for ahead, left in path]
    (x, y), (a, b) = points[-1], (0.0, 0.0)
    for ahead, left in points:
        if math.hypot(ahead, left) >= lookahead > math.hypot(a, b):
            # |before + t * step| = lookahead, of which the larger root lies on the way out.
            da, db = ahead - a, left - b
            along, size = a * da + b * db, da * da + db * db
            t = (-along + math.sqrt(along * along - size * (a * a + b * b - lookahead * lookahead))) / size
            x, y = a + t * da, b + t * db
            break
        a, b = ahead, left
    distance = x * x + y * y
    return 0.0 if distance < STANDSTILL**2 else 2.0 * y / distance
