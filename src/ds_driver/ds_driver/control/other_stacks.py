# SPDX-License-Identifier: Apache-2.0
"""Commands of other driving stacks: conversion, matching to frames by their stamps, and speed control. No ROS.

The table of signs and units is in docs/drivers.md.

Sources: REP-103 (left positive); the bicycle model (Rajamani, Vehicle Dynamics and Control, 2012, section 2.2); the
comments in ackermann_msgs/AckermannDrive.msg, autoware_control_msgs/Lateral.msg and deepracer_interfaces_pkg/
ServoCtrlMsg.msg; the sign of the last from AWS's node cmdvel_to_servo, which sends a positive angle for a left turn.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from operator import attrgetter
from typing import Any, Generic, TypeVar

from ds_driver.control.bicycle import Geometry, MotionError

FrameT = TypeVar("FrameT")
CommandT = TypeVar("CommandT")

MAX_FRAMES = 20
"""Number of frames kept; chosen: one second, as a later answer is too late in any case."""
MAX_AHEAD = 1_000_000_000
"""Largest lead of a command's stamp over the newest frame, ns; chosen: it is one frame, 50 ms, ahead at most."""
PROPORTIONAL = 0.3
"""Proportional gain, throttle per m/s of error; chosen by trial on the three vehicles."""
INTEGRAL = 0.005
"""Integral gain, throttle per m/s of error and frame; chosen by trial: at 3 and 6 m/s each of the three vehicles is
within 0.3 m/s after six seconds, with an overshoot of 0.5 m/s at most."""


@dataclass(frozen=True, slots=True)
class MotionRequest:
    """Request of a driver of any stack: steering, -1 full left to +1 full right, and a speed, m/s, or a throttle."""

    steering: float
    speed: float | None = None
    throttle: float | None = None

    def __post_init__(self) -> None:
        named = {"steering": self.steering, "speed": self.speed, "throttle": self.throttle}
        for name, value in named.items():
            if value is not None and not math.isfinite(value):
                raise MotionError(f"{name} is {value}: expected a finite number")
            if name != "steering" and value is not None and value < 0.0:
                raise MotionError(f"{name} is {value:g}: the vehicles here have no reverse gear, expected 0 or more")
        if (self.speed is None) == (self.throttle is None):
            raise MotionError("a request needs either a speed or a throttle")


def set_part(message: Any, path: str, value: Any) -> None:
    """Set an attribute of a message by its path, such as `header.stamp`."""
    owner, _, name = path.rpartition(".")
    setattr(attrgetter(owner)(message) if owner else message, name, value)


def _from_twist(speed: float, yaw_rate: float, geometry: Geometry) -> MotionRequest:
    return MotionRequest(geometry.steering_of(geometry.angle_for(speed, yaw_rate)), speed=speed)


def _to_twist(motion: MotionRequest, geometry: Geometry) -> tuple[float, float]:
    speed = _speed(motion)
    return speed, geometry.yaw_rate_of(speed, geometry.angle_of(motion.steering))


def _from_angle(angle: float, speed: float, geometry: Geometry) -> MotionRequest:
    return MotionRequest(geometry.steering_of(angle), speed=speed)


def _to_angle(motion: MotionRequest, geometry: Geometry) -> tuple[float, float]:
    return geometry.angle_of(motion.steering), _speed(motion)


def _from_servo(angle: float, throttle: float, _geometry: Geometry) -> MotionRequest:
    for name, value in (("angle", angle), ("throttle", throttle)):
        if abs(value) > 1.0:
            raise MotionError(f"{name} is {value:g}: expected a share from -1 to 1, not a pulse width")
    return MotionRequest(-angle, throttle=throttle)


def _to_servo(motion: MotionRequest, _geometry: Geometry) -> tuple[float, float]:
    if motion.throttle is None:
        raise MotionError("a ServoCtrlMsg needs a throttle, not a speed")
    return -motion.steering, motion.throttle


def _speed(motion: MotionRequest) -> float:
    if motion.speed is None:
        raise MotionError("this message needs a speed, not a throttle")
    return motion.speed


@dataclass(frozen=True)
class MessageKind:
    """Type of message used by other stacks to drive."""

    package: str
    type_name: str
    topic: str  # usual one, relative
    stamp: str  # attribute path from the message to its stamp; "" if it has none
    fields: tuple[str, str]  # attribute paths from the message to its two numbers
    decode: Callable[[float, float, Geometry], MotionRequest]  # of these numbers
    encode: Callable[[MotionRequest, Geometry], tuple[float, float]]
    needs_throttle: bool = False  # instead of a speed

    @property
    def message_class(self) -> Any:
        """Class of the message; a ValueError if its package is not installed."""
        try:
            return getattr(import_module(f"{self.package}.msg"), self.type_name)
        except ImportError:
            raise ValueError(f"{self.package} is not installed: install it, or choose another message") from None

    def read(self, message: Any, geometry: Geometry) -> MotionRequest:
        """Convert a message; a MotionError if it requests what no vehicle here can follow."""
        first, second = map(float, attrgetter(*self.fields)(message))
        for path, value in zip(self.fields, (first, second), strict=True):
            if not math.isfinite(value):
                raise MotionError(f"{path} is {value}: expected a finite number")
        return self.decode(first, second, geometry)

    def fill(self, message: Any, motion: MotionRequest, geometry: Geometry) -> None:
        """Fill a message."""
        for path, value in zip(self.fields, self.encode(motion, geometry), strict=True):
            set_part(message, path, value)


_TWIST = (("linear.x", "angular.z"), _from_twist, _to_twist)
_STAMPED_TWIST = (("twist.linear.x", "twist.angular.z"), _from_twist, _to_twist)
_ACKERMANN = (("drive.steering_angle", "drive.speed"), _from_angle, _to_angle)
_SERVO = (("angle", "throttle"), _from_servo, _to_servo, True)
_AUTOWARE = (("lateral.steering_tire_angle", "longitudinal.velocity"), _from_angle, _to_angle)
KINDS = {
    "twist_stamped": MessageKind("geometry_msgs", "TwistStamped", "cmd_vel", "header.stamp", *_STAMPED_TWIST),
    "twist": MessageKind("geometry_msgs", "Twist", "cmd_vel", "", *_TWIST),
    "ackermann": MessageKind("ackermann_msgs", "AckermannDriveStamped", "ackermann_cmd", "header.stamp", *_ACKERMANN),
    "servo": MessageKind("deepracer_interfaces_pkg", "ServoCtrlMsg", "servo_msg", "", *_SERVO),
    "autoware": MessageKind("autoware_control_msgs", "Control", "control_cmd", "stamp", *_AUTOWARE),
}
"""Name used in parameters -> type of message.

A twist: m/s, and rad/s, left positive. Angles of wheels: rad, left positive, with speeds in m/s. A servo's angle and
throttle: shares in [-1, 1], left positive.
"""


class StampMatcher(Generic[FrameT, CommandT]):
    """Pairs frames and commands, whichever arrives first.

    A command with the stamp of a frame answers that frame, one without a stamp the newest unanswered frame, or else the
    next one to arrive.
    """

    def __init__(self) -> None:
        self._frames: OrderedDict[int, FrameT] = OrderedDict()
        self._early: dict[int, CommandT] = {}
        self._unstamped: CommandT | None = None
        self._newest: int | None = None

    def frame(self, stamp: int, frame: FrameT) -> tuple[FrameT, CommandT] | None:
        """Add a frame; returns the pair if its command arrived before it."""
        self._newest = stamp
        self._frames[stamp] = frame
        self._frames.move_to_end(stamp)
        while len(self._frames) > MAX_FRAMES:
            self._frames.popitem(last=False)
        self._early = {s: c for s, c in self._early.items() if s >= stamp}
        command = self._early.pop(stamp, None)
        if command is None:
            command, self._unstamped = self._unstamped, None
        return None if command is None else (self._frames.pop(stamp), command)

    def command(self, stamp: int, command: CommandT) -> tuple[FrameT, CommandT] | None:
        """Add a command with the stamp of a frame, or 0 for none; returns the pair if its frame has arrived.

        Raises:
            KeyError: no unanswered frame has this stamp: the command is late, a duplicate, or unrelated to a frame.
        """
        if stamp == 0:
            if not self._frames:
                self._unstamped = command
                return None
            _, frame = self._frames.popitem()
            self._frames.clear()
            return frame, command
        if stamp in self._frames:
            return self._frames.pop(stamp), command
        if self._newest is not None and not self._newest < stamp <= self._newest + MAX_AHEAD:
            raise KeyError(stamp)
        self._early = {stamp: command} if self._newest is None else self._early | {stamp: command}
        return None


class SpeedController:
    """PI controller on the speed with anti-windup, updated once per frame."""

    def __init__(self) -> None:
        self._integral = 0.0

    def reset(self) -> None:
        """Reset the integral at the start of a run."""
        self._integral = 0.0

    def throttle(self, desired: float, speed: float) -> float:
        """Throttle in [0, 1] for speeds in m/s; 0 to stop, because the vehicles have no brake and coast."""
        if desired <= 0.0:
            self._integral = 0.0
            return 0.0
        error = desired - speed
        unclipped = PROPORTIONAL * error + self._integral + INTEGRAL * error
        throttle = min(max(unclipped, 0.0), 1.0)
        if throttle == unclipped or (unclipped > 1.0) != (error > 0.0):
            self._integral = min(max(self._integral + INTEGRAL * error, 0.0), 1.0)
        return throttle
