# SPDX-License-Identifier: Apache-2.0
"""Publishes the messages of a bag with their recorded bytes, topics and QoS, and its time on /clock."""

from __future__ import annotations

import time
from collections.abc import Iterable
from importlib import import_module
from types import TracebackType
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Connection, ConnectionExtRosbag2, QosDurability, QosReliability
from rosgraph_msgs.msg import Clock

from ds_bags.layout import printable
from ds_base.bounded_json import read_json
from ds_base.installation import share_folders
from ds_sim.ros.runtime import init_ros

QUEUE = 5000
"""Queue depth for slow subscribers, messages; chosen: more than a run has on any topic."""
IN_FLIGHT = 8 * 2**20
"""Bytes on a topic after which a replay without pauses waits for its subscribers; chosen: some fifty images. Waiting
after every message would cost seconds: Fast DDS acknowledges small ones only by its heartbeat, every 3 s."""
GRACE = 0.2
"""s between the first discovered subscriber and the first message: a node's subscriptions appear one by one."""
ARRIVAL = 5.0
"""s to wait for the acknowledgement of messages."""


class GraphOutput:
    """Publishers for the topics of a bag; satisfies `ds_bags.player.Output`.

    Args:
        connections: topics to publish.
        patient: wait for reliable subscribers before a queue overflows.

    Attributes:
        skipped: topic -> reason why it is not published.
    """

    def __init__(self, connections: Iterable[Connection], *, patient: bool) -> None:
        init_ros()
        self._node = Node("bag_replay", start_parameter_services=False)
        self._patient = patient
        self._publishers: dict[int, Publisher] = {}
        self._in_flight: dict[int, tuple[int, int]] = {}
        self.skipped: dict[str, str] = {}
        self._clock = self._node.create_publisher(Clock, "/clock", 10)
        for connection in connections:
            kind, reason = _message_class(connection)
            if not reason:
                try:
                    publisher = self._node.create_publisher(kind, connection.topic, _qos(connection))
                    self._publishers[connection.id] = publisher
                except (NameValidationException, ValueError, RuntimeError) as error:
                    reason = (
                        f"it cannot be published ({printable(str(error).splitlines()[0] if str(error) else error)})"
                    )
            if reason:
                self.skipped[printable(connection.topic)] = reason

    def wait_for_readers(self, seconds: float) -> bool:
        """Wait for a subscriber; return False if there is none after `seconds`."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if any(publisher.get_subscription_count() for publisher in self._publishers.values()):
                time.sleep(GRACE)
                return True
            time.sleep(0.02)
        return False

    def publish(self, connection: Connection, raw: bytes) -> None:
        """Publish the recorded bytes of a message, unless its topic is skipped."""
        publisher = self._publishers.get(connection.id)
        if publisher is None:
            return
        publisher.publish(raw)
        count, size = self._in_flight.get(connection.id, (0, 0))
        count, size = count + 1, size + len(raw)
        if self._patient and (count >= QUEUE or size >= IN_FLIGHT):
            publisher.wait_for_all_acked(Duration(seconds=ARRIVAL))
            count = size = 0
        self._in_flight[connection.id] = count, size

    def clock(self, nanoseconds: int) -> None:
        """Publish the time of the bag, ns, on /clock."""
        message = Clock()
        message.clock.sec, message.clock.nanosec = nanoseconds // 10**9, nanoseconds % 10**9
        self._clock.publish(message)

    def __enter__(self) -> GraphOutput:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            for publisher in self._publishers.values():
                publisher.wait_for_all_acked(Duration(seconds=ARRIVAL))
        self._node.destroy_node()
        rclpy.try_shutdown()


def _message_class(connection: Connection) -> tuple[Any, str]:
    """Return the message class of a topic, or the reason why there is none.

    The bag names the type, and importing a package runs its code: only message packages installed in the ROS workspace
    are imported.
    """
    package, _, kind = connection.msgtype.partition("/msg/")
    plain = package.isidentifier() and kind.isidentifier()
    if not (plain and any((share / "msg" / f"{kind}.msg").is_file() for share in share_folders(package))):
        return None, f"{printable(connection.msgtype)} is not installed here"
    try:
        message_class = getattr(import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError):
        return None, f"{connection.msgtype} is not installed here"
    installed = _installed_digest(package, kind)
    if installed and connection.digest and installed != connection.digest:
        return None, f"{connection.msgtype} is installed in another version than the bag has"
    return message_class, ""


def _installed_digest(package: str, kind: str) -> str:
    """Return the RIHS01 hash of an installed type, or "" if it is unknown."""
    for file in (share / "msg" / f"{kind}.json" for share in share_folders(package)):
        if file.is_file():
            hashes = read_json(file).get("type_hashes", [])
            name = f"{package}/msg/{kind}"
            return next((str(entry["hash_string"]) for entry in hashes if entry["type_name"] == name), "")
    return ""


def _qos(connection: Connection) -> QoSProfile:
    """Return the QoS that the recorded publisher offered, with a longer queue."""
    ext = connection.ext
    offered = (
        ext.offered_qos_profiles[0] if isinstance(ext, ConnectionExtRosbag2) and ext.offered_qos_profiles else None
    )
    latched = offered is not None and offered.durability == QosDurability.TRANSIENT_LOCAL
    best_effort = offered is not None and offered.reliability == QosReliability.BEST_EFFORT
    return QoSProfile(
        depth=_depth(offered.depth) if offered is not None and latched else QUEUE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
    )


def _depth(offered: object) -> int:
    """Return the recorded queue depth, or `QUEUE` if it is not a valid one."""
    return offered if type(offered) is int and 0 < offered <= QUEUE else QUEUE
