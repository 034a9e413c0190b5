# SPDX-License-Identifier: Apache-2.0
"""Publishes how a node does on `/diagnostics`, for ROS's robot monitor and Foxglove (REP-107)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

OK, WARN, ERROR, STALE = (getattr(DiagnosticStatus, name) for name in ("OK", "WARN", "ERROR", "STALE"))
EVERY = 1.0
"""Period of the reports, s; the default of diagnostic_updater."""
WINDOW = 200
"""Number of frames in the statistics of the latency; chosen: ten seconds at 20 Hz."""

Report = tuple[bytes, str, Mapping[str, object]]
"""Level, one line for a person, and values by their names."""


class Diagnostics:
    """Publishes one status once a second, while a node subscribes."""

    def __init__(self, node: Node, name: str, report: Callable[[], Report]) -> None:
        self._node, self._name, self._report = node, name, report
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 1)
        # Steady clock: under use_sim_time the node's own stands still between runs.
        node.create_timer(EVERY, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        level, text, values = self._report()
        if not self._publisher.get_subscription_count():
            return
        status = DiagnosticStatus(level=level, name=f"{self._node.get_name()}: {self._name}", message=text)
        status.hardware_id = self._node.get_fully_qualified_name()
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


class AnswerDiagnostics:
    """Publishes how many frames a driver answers and refuses, and its latency from a frame to its command.

    Without frames the level is `idle`: OK for a driver of simulators, which wait for goals.
    """

    def __init__(self, node: Node, idle: bytes = OK) -> None:
        self.answered = self.refused = 0
        self._idle, self._last = idle, (0, 0)
        self._seconds: deque[float] = deque(maxlen=WINDOW)
        Diagnostics(node, "latency", self._report)

    def add(self, seconds: float) -> None:
        """Record that a frame was answered after a time in s."""
        self._seconds.append(seconds)
        self.answered += 1

    def _report(self) -> Report:
        answered, refused = self.answered - self._last[0], self.refused - self._last[1]
        self._last = (self.answered, self.refused)
        values = {"frames answered": str(self.answered), "frames refused": str(self.refused)}
        if self._seconds:
            times = 1e3 * np.array(self._seconds)
            values["latency mean ms"] = f"{times.mean():.3f}"
            values["latency p95 ms"] = f"{np.quantile(times, 0.95):.3f}"
            values["latency max ms"] = f"{times.max():.3f}"
        if refused:
            return ERROR, f"{refused} images refused in the last second: see the log", values
        if not answered:
            return self._idle, "no image in the last second", values
        return OK, f"{answered} images answered in the last second", values
