"""Models the actuators: steering rack and motor."""

from __future__ import annotations

import math

from ds_sim.simulator import Command
from ds_sim_softbody.parameters import SoftbodyParameters


class Steering:
    """Steering rack with a limited rate.

    Args:
        p: parameters of the car.
    """

    def __init__(self, p: SoftbodyParameters) -> None:
        self._p = p
        self.angle = 0.0
        """Mean angle of the front wheels set by the rack, rad, left positive."""

    def advance(self, command: Command, dt: float) -> tuple[float, float]:
        """Move towards the command for dt (s); returns the angles of the left and right wheel, rad, left positive."""
        p = self._p
        # The sign of the command is that of the paper, right positive.
        target = -command.steering * p.max_steering_angle
        step = p.steering_rate * dt
        self.angle += min(max(target - self.angle, -step), step)
        tangent = math.tan(self.angle)
        narrow = p.ackermann * tangent * p.track / (2.0 * p.wheelbase)
        return math.atan2(tangent, 1.0 - narrow), math.atan2(tangent, 1.0 + narrow)


class Motor:
    """Electric motor with a one-pedal map that drives the rear axle through an open differential.

    Args:
        p: parameters of the car.
    """

    def __init__(self, p: SoftbodyParameters) -> None:
        self._p = p
        self._gain = p.wheel_radius / 2.0
        self.torque = 0.0
        """Torque at each of the two rear wheels, N m."""

    def advance(self, command: Command, wheel_speed: float, dt: float) -> float:
        """Follow the pedal for dt; returns the torque at each rear wheel, N m.

        Args:
            command: command of the driver.
            wheel_speed: mean speed of the treads of the rear wheels, m/s.
            dt: duration, s.
        """
        p = self._p
        generating = min(max(wheel_speed / p.fade_speed, -1.0), 1.0)
        drive = p.drive_force if p.drive_force * wheel_speed < p.power else p.power / wheel_speed
        drive *= min(max(p.top_speed - wheel_speed, 0.0), 1.0)
        force = drive * command.throttle - p.regenerative_force * generating * (1.0 - command.throttle)
        self.torque += (force * self._gain - self.torque) * (1.0 - math.exp(-dt / p.motor_lag))
        return self.torque
