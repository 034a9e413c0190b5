# SPDX-License-Identifier: Apache-2.0
"""Detects nodes that would disturb a simulator's run: a second simulator, a second driver, other clients."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.utilities import get_rmw_implementation_identifier
from std_msgs.msg import Empty

from ds_sim.ros.requests import RequestRefused
from ds_sim.simulator import Reason

PRESENCE_QOS = QoSProfile(depth=1, liveliness=LivelinessPolicy.AUTOMATIC, liveliness_lease_duration=Duration(seconds=2))
"""A killed simulator stays in the ROS graph for 20 s, but its liveliness ends within these 2 s."""
FEEDBACK = "drive_road/_action/feedback"
"""Topic that every client of the action subscribes to."""


class Presence:
    """Counts the nodes of a kind in a namespace, by the liveliness of a topic on which none says anything."""

    def __init__(self, node: Node, topic: str, on_more: Callable[[], None]) -> None:
        self.others, self._on_more = 0, on_more
        # Fast DDS does not report a participant's own publishers.
        self._own = 0 if get_rmw_implementation_identifier().startswith("rmw_fastrtps") else 1
        self._publisher = node.create_publisher(Empty, topic, PRESENCE_QOS)
        events = SubscriptionEventCallbacks(liveliness=lambda status: self._on_liveliness(status.alive_count))
        node.create_subscription(Empty, topic, lambda _: None, PRESENCE_QOS, event_callbacks=events)

    def _on_liveliness(self, alive: int) -> None:
        before, self.others = self.others, alive - self._own
        if self.others > before:
            self._on_more()


class Neighbours:
    """Watches the namespace of a simulator's node."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._presence = Presence(node, "presence", lambda: node.get_logger().error(self.crowd()))

    def crowd(self) -> str:
        """Describe several simulators in the namespace; "" if this is the only one."""
        if self._presence.others <= 0:
            return ""
        return (
            f"{self._presence.others + 1} simulators live in {self._node.get_namespace()}: stop all but one, or give "
            "them other namespaces (__ns:=)"
        )

    def drivers(self) -> list[str]:
        """Return the names of the nodes that publish commands, one per publisher."""
        return names_of(self._node.get_publishers_info_by_topic(self._node.resolve_topic_name("drive")))

    def clients(self) -> list[str]:
        """Return the names of the nodes with a client of the action."""
        return names_of(self._node.get_subscriptions_info_by_topic(self._node.resolve_topic_name(FEEDBACK)))

    def busy(self, road_id: str) -> RequestRefused:
        """Make the refusal of a request that arrives during a run on this road."""
        clients = ", ".join(self.clients()) or "none that is alive"
        return RequestRefused(
            Reason.BUSY,
            f"a run on road {road_id} is under way (clients: {clients}): wait for its result, cancel it, or call reset",
        )

    def check_alone(self) -> None:
        """Refuse a request, as TWO_SIMULATORS, if another simulator runs here; two drivers show by their commands.

        These are not counted, as a killed one stays in the ROS graph for 20 s next to its replacement.
        """
        if crowd := self.crowd():
            raise RequestRefused(Reason.TWO_SIMULATORS, crowd)


def names_of(endpoints: Iterable[TopicEndpointInfo]) -> list[str]:
    """Return the sorted full node names of publishers or subscriptions, without those not yet discovered by name."""
    return sorted(f"{e.node_namespace.rstrip('/')}/{e.node_name}" for e in endpoints if "UNKNOWN" not in e.node_name)


def two_drivers(names: list[str]) -> str:
    """Describe drivers that publish to the same topic, in one line."""
    return f"two drivers send commands ({', '.join(names)}): stop one of them"
