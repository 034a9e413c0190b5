# SPDX-License-Identifier: Apache-2.0
"""Connects a driver to simulators: asks for their descriptions, and answers each frame with a command of its stamp."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from ds_interfaces.msg import DriveCommand, Frame, VehicleState
from ds_interfaces.srv import GetSimulatorInfo
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import Header

from ds_driver.networks.pilot import DriverError
from ds_sim.ros.conversions import MESSAGES
from ds_sim.ros.diagnostics import AnswerDiagnostics
from ds_sim.ros.runtime import end_with
from ds_sim.simulator import Command

Answer = Callable[[Any], Command]
"""Maps a `Frame` or a `VehicleState` to a command."""

LOCKSTEP_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
ASK_EVERY = 0.5
"""Time between two requests, s; a request to a process that has just died is never answered."""
REPORT_EVERY = 30.0
"""Time between two log lines about missing answers, s."""
LIMIT = 600.0
"""Time after which a driver that has found no simulator gives up, s; chosen: leaves time to start them by hand."""

OnInfo = Callable[[int, GetSimulatorInfo.Response], None]


def refusal(header: Header, error: Exception) -> DriveCommand:
    """Answer a frame with the reason why there is no command, which the result of the run repeats."""
    return DriveCommand(header=header, steering=math.nan, throttle=math.nan, refusal=str(error))


class SimulatorClient:
    """Subscribes to each `Frame` of one simulator, or `VehicleState` for a driver without eyes, and publishes answers.

    Its topics appear in the ROS graph with the first call of `drive_with`, when it can answer. The namespace "" is the
    node's own. `on_start` is called at the first frame of each run, which then waits for `drive_with`.
    """

    def __init__(
        self,
        node: Node,
        namespace: str,
        kind: type[Frame] | type[VehicleState],
        answers: AnswerDiagnostics,
        on_start: Callable[[], None] | None = None,
    ) -> None:
        self._node = node
        self._prefix = f"{namespace}/" if namespace else ""
        self._kind = kind
        self._answers = answers
        self._on_start = on_start
        self._answer: Answer | None = None
        self._drive: Publisher | None = None
        self._waiting: Any = None
        self._start: Time | None = None

    def drive_with(self, answer: Answer) -> None:
        """Answer each frame from now on, including one that is waiting.

        A ValueError of `answer` leaves a frame unanswered, and is logged in one line. A DriverError, which would recur
        with every frame, is published as a refusal.
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
        began = time.monotonic()
        try:
            command = self._answer(message)
        except ValueError as error:
            self._answers.refused += 1
            self._node.get_logger().error(f"frame not answered: {error}", throttle_duration_sec=1.0)
            if isinstance(error, DriverError):
                self._drive.publish(refusal(message.header, error))
            return
        self._drive.publish(MESSAGES.command(command, message.header))
        self._answers.add(time.monotonic() - began)


class SimulatorInfo:
    """Clients of `get_info` for a driver's simulators; `on_info` gets the index of the namespace and the answer.

    `purpose` says in the log what the answer is for, and how to avoid the request.
    """

    def __init__(self, node: Node, namespaces: Sequence[str], purpose: str, on_info: OnInfo) -> None:
        self._node = node
        self._names = [name or node.get_namespace() for name in namespaces]
        self._purpose = purpose
        self._on_info = on_info
        self._clients = [
            node.create_client(GetSimulatorInfo, f"{name}/get_info" if name else "get_info") for name in namespaces
        ]
        self._pending: set[int] = set()
        self._found_any = False
        self._began = time.monotonic()
        self._reported = float("-inf")
        self._timer = node.create_timer(ASK_EVERY, self._ask_again, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def ask(self, index: int) -> None:
        """Ask the simulator of a namespace until it answers."""
        self._pending.add(index)
        self._timer.reset()
        self._send(index)

    def _send(self, index: int) -> None:
        if self._clients[index].service_is_ready():
            future = self._clients[index].call_async(GetSimulatorInfo.Request())
            future.add_done_callback(lambda answer: self._receive(index, answer))

    def _receive(self, index: int, answer: Future) -> None:
        info = answer.result()
        if info is None or index not in self._pending:
            return
        self._pending.discard(index)
        self._found_any = True
        self._on_info(index, info)

    def _ask_again(self) -> None:
        if not self._pending:
            self._timer.cancel()
            return
        now = time.monotonic()
        missing = ", ".join(self._names[index] for index in sorted(self._pending))
        if not self._found_any and now - self._began > LIMIT:
            message = f"no get_info in {missing} within {LIMIT:.0f} s, {self._purpose}: start the simulator first"
            end_with(ValueError(message))
        if now - self._reported > REPORT_EVERY:
            self._reported = now
            self._node.get_logger().info(f"waiting for get_info in {missing}, {self._purpose}")
        for index in tuple(self._pending):
            self._send(index)
