"""Asks simulators for their description, and logs what a driver waits for."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from ds_interfaces.srv import GetSimulatorInfo
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future

from ds_sim.ros.runtime import end_with

ASK_EVERY = 0.5
"""Time between two requests, s; a request to a process that has just died is never answered."""
REPORT_EVERY = 30.0
"""Time between two log lines about missing answers, s."""
LIMIT = 600.0
"""Time after which a driver that has found no simulator gives up, s; chosen: leaves time to start them by hand."""

OnInfo = Callable[[int, GetSimulatorInfo.Response], None]


class SimulatorInfo:
    """Clients of `get_info` for a driver's simulators.

    Args:
        node: node that owns the clients.
        namespaces: namespaces of the simulators; "" for the node's own.
        purpose: for the log: what the answer is for, and how to avoid the request.
        on_info: called with the index of the namespace and the answer.
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
