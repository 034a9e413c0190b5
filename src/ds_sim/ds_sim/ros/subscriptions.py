# SPDX-License-Identifier: Apache-2.0
"""Subscribes to the commands of other people's drivers, whatever reliability they offer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy


def subscribe_to_commands(node: Node, kind: Any, topic: str, callback: Callable[..., None], depth: int) -> None:
    """Subscribe reliably until a publisher offers best effort only, to which no reliable subscription connects.

    ROS's `BEST_AVAILABLE` decides by the publishers that are there already, and drivers come later.
    """

    def relax(_event: object) -> None:
        node.get_logger().warning(
            f"{topic}: a publisher offers best effort only, so commands may be lost: publish reliably"
        )
        node.destroy_subscription(reliable)
        profile = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(kind, topic, callback, profile)

    events = SubscriptionEventCallbacks(incompatible_qos=relax)
    reliable = node.create_subscription(kind, topic, callback, depth, event_callbacks=events)
