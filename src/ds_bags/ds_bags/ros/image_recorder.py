# SPDX-License-Identifier: Apache-2.0
"""Records the images of a run from the ROS graph, for simulators that this process cannot re-simulate."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ds_interfaces.msg import DriveCommand, VehicleState
from ds_interfaces.srv import GetSimulatorInfo
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image

from ds_bags.messages import frame_times, typestore
from ds_bags.reader import STATE, BagReader, stamp_of
from ds_bags.rosbag2_writer import Rosbag2Writer, topic_of
from ds_bags.verification import IMAGE
from ds_sim.ros.node_thread import NodeThread
from ds_sim.session import RunRecord
from ds_sim.simulator import Observation

QUEUE = 600
"""Depth of the subscription queues, messages; as deep as cameras publish (`ds_sim.ros.frame_publisher`)."""
ROUNDING = 1000
"""Tolerance of stamps, ns: a sum of two floats is rounded; chosen far below the 50 ms between frames."""
_KINDS: dict[str, tuple[Any, str]] = {
    "state": (VehicleState, STATE),
    "drive": (DriveCommand, "ds_interfaces/msg/DriveCommand"),
    "camera/image_raw": (Image, IMAGE),
}


class ImageRecorder:
    """Writes the messages of one simulator into a bag as they arrive. Use it as a context manager around a run.

    Args:
        folder: folder of the bag; must not exist.
        namespace: ROS namespace of the simulator.
        facts: custom data of the bag, from `ds_bags.run_writer.facts_of`; a killed recorder leaves them too.
        context: ROS context in the domain of the simulator.
    """

    def __init__(self, folder: Path, namespace: str, facts: dict[str, str], context: Context) -> None:
        self.folder = folder
        self.images = 0
        self._facts = facts
        self._writer = Rosbag2Writer(folder, facts)
        self._node = Node("bag_recorder", start_parameter_services=False, context=context)
        self._namespace = namespace
        self._last: dict[int, int] = {}
        for topic, (kind, name) in _KINDS.items():
            channel = self._writer.channel(topic_of(typestore(), f"{namespace}/{topic}", name, depth=QUEUE))
            self._node.create_subscription(
                kind,
                f"{namespace}/{topic}",
                lambda raw, channel=channel, topic=topic: self._keep(channel, topic, raw),  # type: ignore[misc]
                QoSProfile(depth=QUEUE),
                raw=True,
            )
        # After the subscriptions, see wait_for_simulator.
        self._info = self._node.create_client(GetSimulatorInfo, f"{namespace}/get_info")
        self._thread = NodeThread(self._node)

    def wait_for_simulator(self, limit: float = 10.0) -> bool:
        """Wait until the simulator's publishers reach this recorder; return False after `limit` seconds.

        That a camera is in the ROS graph does not mean that it has heard of its new subscriber. A participant announces
        its endpoints in order (DDSI-RTPS 2.5, section 8.5.4), so whoever answers a client that was created after the
        subscriptions has heard of them.
        """
        deadline = time.monotonic() + limit
        camera = f"{self._namespace}/camera/image_raw"
        if not self._until(lambda: self._node.count_publishers(camera) > 0, limit):
            return False
        return self._thread.ask(self._info, GetSimulatorInfo.Request(), deadline - time.monotonic()) is not None

    def wait_for_images(self, count: int, limit: float = 3.0) -> None:
        """Wait until `count` images have arrived, or for `limit` seconds."""
        self._until(lambda: self.images >= count, limit)

    def _until(self, done: Callable[[], bool], limit: float) -> bool:
        deadline = time.monotonic() + limit
        while not done():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.02)
        return True

    def _keep(self, channel: int, topic: str, raw: bytes) -> None:
        # All three types begin with a header, and a header with its stamp, after four bytes of CDR encapsulation.
        seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
        stamp = seconds * 10**9 + nanoseconds
        if self._last.get(channel) == stamp:
            return  # simulators resend the first frame until it is answered
        self._last[channel] = stamp
        self._writer.write(channel, stamp, bytes(raw))
        self.images += topic == "camera/image_raw"

    def __enter__(self) -> ImageRecorder:
        return self

    def __exit__(self, *_: object) -> None:
        if self._thread.end():
            self._node.destroy_node()
        self._writer.close(self._facts)


def with_images(run: RunRecord, folder: Path) -> Iterator[Observation]:
    """Yield the observations of a run with the images of an `ImageRecorder`, empty where one did not arrive."""
    times = frame_times(run).tolist()
    with BagReader(folder) as bag:
        start = _start_of(run, times, bag)
        recorded = bag.decoded([] if start is None else bag.of_type(IMAGE))
        images = (image for _, _, image in recorded if image.encoding == "rgb8")
        image = next(images, None)
        for observation, when in zip(run.observations, times, strict=True):
            wanted = (start or 0) + when
            while image is not None and stamp_of(image) < wanted - ROUNDING:
                image = next(images, None)
            pixels = np.empty((0, 0, 3), np.uint8)
            if image is not None and stamp_of(image) <= wanted + ROUNDING:
                pixels = image.data.reshape(image.height, image.width, 3)
            yield replace(observation, image=pixels)


def _start_of(run: RunRecord, frames: Sequence[int], bag: BagReader) -> int | None:
    """Find the stamp of a run's start, ns: a node's stamps do not begin at 0, and any state may be missing."""
    times = {observation.step: when for observation, when in zip(run.observations, frames, strict=True)}
    start: int | None = None
    for _, _, state in bag.decoded(bag.of_type(STATE)):
        if state.road_id == run.road.road_id and state.step in times:
            start = stamp_of(state) - times[state.step]  # the last one: another client's run may have come before
    return start
