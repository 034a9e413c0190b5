"""Connects a driver to one simulator: answers each message about a frame with a command that carries its stamp."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from ds_interfaces.msg import DriveCommand, Frame, VehicleState
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy

from ds_driver.networks.pilot import DriverError
from ds_sim.simulator import Command

Answer = Callable[[Any], Command]
"""Maps a `Frame` or a `VehicleState` to a command."""

LOCKSTEP_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class SimulatorClient:
    """Subscribes to the frames or the states of one simulator, and publishes the answer to each.

    Its topics appear in the ROS graph with the first call of `drive_with`, when it can answer.

    Args:
        node: node that owns the subscription.
        namespace: namespace of the simulator; "" for the node's own.
        kind: what to subscribe to: `Frame`, or `VehicleState` for a driver without eyes.
        on_start: called at the first frame of each run, which then waits for `drive_with`; None to answer all runs
            alike.
    """

    def __init__(
        self,
        node: Node,
        namespace: str,
        kind: type[Frame] | type[VehicleState],
        on_start: Callable[[], None] | None = None,
    ) -> None:
        self._node = node
        self._prefix = f"{namespace}/" if namespace else ""
        self._kind = kind
        self._on_start = on_start
        self._answer: Answer | None = None
        self._drive: Publisher | None = None
        self._waiting: Any = None
        self._start: Time | None = None

    def drive_with(self, answer: Answer) -> None:
        """Answer frames from now on, including one that is waiting.

        Args:
            answer: called once per frame. A ValueError leaves the frame unanswered and is logged in one line. After a
                DriverError, which would recur with every frame, an invalid command is published, so that the result
                of the run states the cause.
        """
        self._answer = answer
        if self._drive is None:
            topic = "frame" if self._kind is Frame else "state"
            self._drive = self._node.create_publisher(DriveCommand, f"{self._prefix}drive", 1)
            self._node.create_subscription(self._kind, f"{self._prefix}{topic}", self._on_message, LOCKSTEP_QOS)
        if self._waiting is not None:
            message, self._waiting = self._waiting, None
            self._respond(message)

    def _on_message(self, message: Any) -> None:
        if message.step == 0 and self._on_start is not None and message.header.stamp != self._start:
            self._start, self._answer, self._waiting = message.header.stamp, None, message
            self._on_start()
        elif self._answer is None:
            self._waiting = message
        else:
            self._respond(message)

    def _respond(self, message: Any) -> None:
        assert self._answer is not None and self._drive is not None
        try:
            command = self._answer(message)
        except ValueError as error:
            self._node.get_logger().error(f"frame not answered: {error}", throttle_duration_sec=1.0)
            if isinstance(error, DriverError):
                self._drive.publish(DriveCommand(header=message.header, steering=math.nan, throttle=0.0))
            return
        answer = DriveCommand(header=message.header, steering=command.steering, throttle=command.throttle)
        self._drive.publish(answer)
