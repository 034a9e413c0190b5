# SPDX-License-Identifier: Apache-2.0
"""Publishes a driver's commands as `DriveCommand` or as another stack's messages."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

from ds_interfaces.msg import DriveCommand
from rclpy.node import Node
from std_msgs.msg import Header

from ds_driver.control.bicycle import Geometry
from ds_driver.control.other_stacks import KINDS, MessageKind, MotionRequest, set_part
from ds_sim.ros.conversions import MESSAGES
from ds_sim.simulator import Command

DRIVE_COMMAND = "drive_command"
OUTPUTS = (DRIVE_COMMAND, *KINDS)
"""Values of the parameter `output`: names of the message types."""


def message_type(kind: MessageKind) -> Any:
    """Import the class of a message type.

    Raises:
        ValueError: its package is not installed.
    """
    try:
        return getattr(import_module(f"{kind.package}.msg"), kind.type_name)
    except ImportError:
        raise ValueError(f"{kind.package} is not installed: install it, or choose another message") from None


class CommandOutput:
    """Publishes commands as `DriveCommand`, or as another stack's message.

    For messages with a speed, the throttle is replaced by the speed at which the paper's equation 2 gives throttle 0:
    `max_speed` times the square root of 1 - steering^2.

    Args:
        node: node that owns the publisher.
        output: one of `OUTPUTS`.
        geometry: geometry of the vehicle; not needed for `DriveCommand` and `servo`.
        max_speed: speed at steering 0, m/s.

    Raises:
        ValueError: the geometry is missing, or the package of the message is not installed.
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
            self._publisher.publish(MESSAGES.command(command, header))
            return
        if self._kind.needs_throttle:
            motion = MotionRequest(command.steering, throttle=command.throttle)
        else:
            motion = MotionRequest(command.steering, speed=target_speed(command.steering, self._max_speed))
        message = self._type()
        self._kind.fill(message, motion, self._geometry)
        if self._kind.stamp:
            set_part(message, self._kind.stamp, header.stamp)
        self._publisher.publish(message)


def target_speed(steering: float, max_speed: float) -> float:
    """Compute the speed, m/s, at which equation 2's throttle, 1 - steering^2 - (speed / max_speed)^2, is 0."""
    return max_speed * math.sqrt(max(0.0, 1.0 - steering**2))
