# SPDX-License-Identifier: Apache-2.0
"""Reads images and odometry of another simulator, and refuses what makes no sense. Messages are read by attribute."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.images import ImageError, fit_to_network, rgb_of_message
from ds_sim.simulator import SimulatorError, VehicleState
from ds_sim_ros.settings import OriginSettings, RosSettings

UNIT_TOLERANCE = 0.01
"""Largest difference of a quaternion's norm from 1; chosen: far above the rounding of 32-bit floats."""


def image_of(message: Any, topic: str) -> NDArray[np.uint8]:
    """Bring a sensor_msgs/Image to (160, 320, 3) uint8 RGB, read-only; SimulatorError if that is impossible."""
    try:
        image = fit_to_network(rgb_of_message(message))
    except ImageError as error:
        raise SimulatorError(f"{topic}: {error}: publish rgb8 or bgr8") from None
    image = image.copy()  # the message's own bytes may be reused
    image.setflags(write=False)
    return image


class OdometryReader:
    """Converts the nav_msgs/Odometry of one run to states in the road frame."""

    def __init__(self, settings: RosSettings) -> None:
        self._topic, self._origin, self._vehicle = settings.odometry, settings.origin, settings.vehicle
        self._yaw, self._ground = 0.0, 0.0

    def begin(self, message: Any, yaw: float) -> None:
        """Begin a run at a yaw, rad, and take the present height as the ground's."""
        self._yaw, self._ground = yaw, float(message.pose.pose.position.z)

    def state(self, message: Any, steering: float) -> VehicleState:
        """Convert a nav_msgs/Odometry; yaws continue the ones before, also beyond a full circle.

        Its twist is in the vehicle's frame, as REP-105 has it. It has no angle of the wheels: the one that the last
        command asked for is reported.

        Raises:
            SimulatorError: a value is not finite, or the orientation is no unit quaternion.
        """
        self._check(message)
        position, twist = message.pose.pose.position, message.twist.twist
        roll, pitch, yaw = _angles(message.pose.pose.orientation)
        yaw = self._yaw + math.remainder(yaw - self._origin.yaw - self._yaw, math.tau)
        self._yaw = yaw
        x, y = _in_road(position.x, position.y, self._origin)
        ahead = self._vehicle.centre_ahead
        return VehicleState(
            x=x + ahead * math.cos(yaw),
            y=y + ahead * math.sin(yaw),
            yaw=yaw,
            speed=twist.linear.x,
            lateral_speed=twist.linear.y + ahead * twist.angular.z,
            yaw_rate=twist.angular.z,
            steering_angle=-steering * self._vehicle.max_steering_angle,
            roll=roll,
            pitch=pitch,
            heave=position.z - self._ground,
        )

    def _check(self, message: Any) -> None:
        pose, twist = message.pose.pose, message.twist.twist
        parts = {"position": pose.position, "orientation": pose.orientation, "linear": twist.linear}
        parts["angular"] = twist.angular
        for part, value in parts.items():
            for axis in "xyzw" if part == "orientation" else "xyz":
                number = getattr(value, axis)
                if not math.isfinite(number):
                    raise SimulatorError(
                        f"{self._topic}: {part}.{axis} is {number}, expected a finite number: the simulator diverged"
                    )
        q = pose.orientation
        norm = math.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2)
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise SimulatorError(f"{self._topic}: the orientation has the norm {norm:.3g}, expected a unit quaternion")


def _angles(q: Any) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a unit quaternion, rad (REP-103)."""
    roll = math.atan2(2.0 * (q.w * q.x + q.y * q.z), 1.0 - 2.0 * (q.x**2 + q.y**2))
    pitch = math.asin(min(max(2.0 * (q.w * q.y - q.z * q.x), -1.0), 1.0))
    return roll, pitch, math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))


def _in_road(x: float, y: float, origin: OriginSettings) -> tuple[float, float]:
    """Convert a position, m, from the odometry's frame to the road frame."""
    cos, sin = math.cos(origin.yaw), math.sin(origin.yaw)
    x, y = x - origin.x, y - origin.y
    return cos * x + sin * y, cos * y - sin * x
