"""Publishes a driver's latency as diagnostics once a second."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from ds_driver.control.latency import Latency

EVERY = 1.0
"""Period of the reports, s; the default of diagnostic_updater."""


class LatencyDiagnostics:
    """Publishes `latency` on `/diagnostics`.

    Args:
        node: node of the driver.
    """

    def __init__(self, node: Node) -> None:
        self.latency = Latency()
        self._node = node
        self._last = (0, 0)
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 1)
        node.create_timer(EVERY, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        latency = self.latency
        answered, refused = latency.answered - self._last[0], latency.refused - self._last[1]
        self._last = (latency.answered, latency.refused)
        level, text = DiagnosticStatus.OK, f"{answered} images answered in the last second"
        if refused:
            level, text = DiagnosticStatus.ERROR, f"{refused} images refused in the last second: see the log"
        elif not answered:
            level, text = DiagnosticStatus.STALE, "no image in the last second"
        status = DiagnosticStatus(level=level, name=f"{self._node.get_name()}: latency", message=text)
        status.hardware_id = self._node.get_fully_qualified_name()
        status.values = [KeyValue(key=key, value=value) for key, value in latency.values().items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
