"""Sends a driver's commands as the messages that a stack understands."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

from ds_interfaces.msg import DriveCommand
from rclpy.node import Node
from std_msgs.msg import Header

from ds_driver.control.command_conversions import KINDS, Geometry, MessageKind, Motion, part
from ds_sim.simulator import Command

DRIVE_COMMAND = "drive_command"
OUTPUTS = (DRIVE_COMMAND, *KINDS)
"""Messages by which a driver can drive, by the name that the parameter `output` has."""


def message_type(kind: MessageKind) -> Any:
    """The class of a message.

    Raises:
        ValueError: its package is not installed.
    """
    try:
        return getattr(import_module(f"{kind.package}.msg"), kind.type_name)
    except ImportError:
        raise ValueError(f"{kind.package} is not installed: install it, or choose another message") from None


class CommandOutput:
    """Publishes commands as `DriveCommand`, or as another stack's message.

    A throttle becomes a speed where the message wants one: the speed at which the paper's equation 2 asks for no more
    throttle, top speed times the root of 1 - steering^2.

    Args:
        node: that owns the publisher.
        output: one of `OUTPUTS`.
        geometry: of the vehicle; `DriveCommand` and `servo` do without.
        max_speed: m/s at steering 0.
    """

    def __init__(self, node: Node, output: str, geometry: Geometry | None, max_speed: float) -> None:
        self._kind = KINDS.get(output)
        self._geometry = geometry or Geometry(1.0, 1.0)
        self._max_speed = max_speed
        if self._kind is None:
            self._publisher = node.create_publisher(DriveCommand, "drive", 1)
            return
        if geometry is None and not self._kind.needs_throttle:
            raise ValueError(f"output {output}: set the parameters wheelbase and max_steering_angle of the vehicle")
        self._type = message_type(self._kind)
        self._publisher = node.create_publisher(self._type, self._kind.topic, 1)

    def send(self, command: Command, header: Header) -> None:
        """Publish a command in answer to the image with this header."""
        if self._kind is None:
            message = DriveCommand(header=header, steering=command.steering, throttle=command.throttle)
            self._publisher.publish(message)
            return
        if self._kind.needs_throttle:
            motion = Motion(command.steering, throttle=command.throttle)
        else:
            motion = Motion(command.steering, speed=wanted_speed(command.steering, self._max_speed))
        message = self._type()
        self._kind.fill(part(message, self._kind.body), motion, self._geometry)
        if self._kind.stamp:
            *path, last = self._kind.stamp.split(".")
            setattr(part(message, ".".join(path)), last, header.stamp)
        self._publisher.publish(message)


def wanted_speed(steering: float, max_speed: float) -> float:
    """The speed in m/s at which equation 2's throttle, 1 - steering^2 - (speed / max_speed)^2, comes to 0."""
    return max_speed * math.sqrt(max(0.0, 1.0 - steering**2))
