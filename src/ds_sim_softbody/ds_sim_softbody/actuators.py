"""What a command moves: the steering rack and the motor."""

from __future__ import annotations

import math

from ds_sim.simulator import Command
from ds_sim_softbody.parameters import SoftbodyParameters


class Steering:
    """A rack that moves at a limited rate.

    Args:
        p: of the car.
    """

    def __init__(self, p: SoftbodyParameters) -> None:
        self._p = p
        self.angle = 0.0
        """Mean angle of the front wheels that the rack sets, rad, left positive."""

    def advance(self, command: Command, dt: float) -> tuple[float, float]:
        """Move towards the command for a time dt, s; the angles of the left and the right wheel, rad, left positive."""
        p = self._p
        # The command's sign is the paper's, right positive.
        wanted = -command.steering * p.max_steering_angle
        step = p.steering_rate * dt
        self.angle += min(max(wanted - self.angle, -step), step)
        tangent = math.tan(self.angle)
        narrow = p.ackermann * tangent * p.track / (2.0 * p.wheelbase)
        return math.atan2(tangent, 1.0 - narrow), math.atan2(tangent, 1.0 + narrow)


class Motor:
    """An electric motor with a one-pedal map, on the rear axle through an open differential.

    Args:
        p: of the car.
    """

    def __init__(self, p: SoftbodyParameters) -> None:
        self._p = p
        self._gain = p.wheel_radius / 2.0
        self.torque = 0.0
        """At each of the two rear wheels, N m."""

    def advance(self, command: Command, wheel_speed: float, dt: float) -> float:
        """Follow the pedal for a time dt, s; the torque at each rear wheel, N m.

        Args:
            command: of the driver.
            wheel_speed: mean speed of the rear wheels' treads, m/s.
            dt: s.
        """
        p = self._p
        generating = min(max(wheel_speed / p.fade_speed, -1.0), 1.0)
        drive = p.drive_force if p.drive_force * wheel_speed < p.power else p.power / wheel_speed
        drive *= min(max(p.top_speed - wheel_speed, 0.0), 1.0)
        force = drive * command.throttle - p.regenerative_force * generating * (1.0 - command.throttle)
        self.torque += (force * self._gain - self.torque) * (1.0 - math.exp(-dt / p.motor_lag))
        return self.torque
