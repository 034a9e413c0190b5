# SPDX-License-Identifier: Apache-2.0
"""Playback: order, pace and keys on a simulated clock; the same bytes for a real subscriber."""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ds_bags.player import PAUSE, QUIT, STEP, Controls, Playback, play
from ds_bags.reader import BagReader
from ds_orchestrator.graph.session import RosDomain

DS = [sys.executable, "-m", "ds_cli.main", "bag", "replay"]
MS = 1_000_000
MESSAGES: list[tuple[Any, int, bytes]] = [
    ("a", 1000 * MS, b"1"),
    ("b", 1000 * MS, b"2"),
    ("a", 1050 * MS, b"3"),
    ("b", 1200 * MS, b"4"),
]


class Stage:
    """A simulated wall clock that advances on waits only, keys at given times, and a record of what is published."""

    def __init__(self, keys: dict[float, str] | None = None) -> None:
        self.time = 0.0
        self.keys = dict(keys or {})
        self.sent: list[tuple[float, str]] = []
        self.clocks: list[tuple[float, int]] = []
        self.said: list[str] = []

    def wait(self, seconds: float) -> str:
        assert seconds >= 0.0 and self.time < 100.0
        due = [at for at in self.keys if at <= self.time + seconds]
        if due:
            self.time = max(self.time, min(due))
            return self.keys.pop(min(due))
        self.time += seconds
        return ""

    def publish(self, connection: Any, raw: bytes) -> None:
        self.sent.append((round(self.time, 6), raw.decode()))

    def clock(self, nanoseconds: int) -> None:
        self.clocks.append((round(self.time, 6), nanoseconds))

    def play(self, rate: float) -> Playback:
        controls = Controls(now=lambda: self.time, wait=self.wait, report=self.said.append)
        return play(iter(MESSAGES), self, rate=rate, controls=controls)


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_messages_come_in_order_at_their_time_over_the_rate(rate: float) -> None:
    stage = Stage()
    played = stage.play(rate)
    assert (played.messages, played.moments, played.seconds, played.whole) == (4, 3, 0.2, True)
    assert [text for _, text in stage.sent] == ["1", "2", "3", "4"]
    assert [at for at, _ in stage.sent] == pytest.approx([0.0, 0.0, 0.05 / rate, 0.2 / rate])


def test_the_clock_precedes_every_message_and_never_goes_back() -> None:
    stage = Stage()
    stage.play(0.5)
    times = [nanoseconds for _, nanoseconds in stage.clocks]
    assert times == sorted(times) and {1000 * MS, 1050 * MS, 1200 * MS} <= set(times)
    # It follows the wall clock at half its speed between the messages, 40 times a second.
    assert all(abs(nanoseconds - (1000 * MS + at * 0.5e9)) < 13 * MS for at, nanoseconds in stage.clocks)
    assert max(b[0] - a[0] for a, b in zip(stage.clocks, stage.clocks[1:], strict=False)) < 0.026


def test_as_fast_as_it_goes_takes_no_time_at_all() -> None:
    stage = Stage()
    assert stage.play(math.inf).messages == 4 and stage.time == 0.0


def test_pause_and_go_on_shift_what_is_left() -> None:
    stage = Stage({0.02: PAUSE, 5.02: PAUSE})
    stage.play(1.0)
    # After the pause the clock continues from the last message.
    assert [at for at, _ in stage.sent] == pytest.approx([0.0, 0.0, 5.07, 5.22])
    assert stage.said == ["paused at 0.000 s", "resumed at 0.000 s"]


def test_a_step_sends_one_moment_and_stays_paused() -> None:
    stage = Stage({0.01: STEP, 3.0: STEP, 4.0: QUIT})
    played = stage.play(1.0)
    assert [at for at, _ in stage.sent] == pytest.approx([0.0, 0.0, 0.01, 3.0]) and played.whole
    assert "0.050 s: 1 messages" in stage.said
    stage = Stage({0.01: STEP, 3.0: QUIT})
    assert not stage.play(1.0).whole and len(stage.sent) == 3


@pytest.fixture
def listener() -> Iterator[Callable[[dict[str, Any]], tuple[dict[str, str], list[tuple[str, bytes]]]]]:
    """Subscribe to topics in a separate domain; gives its environment, and the messages in order of arrival."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile

    domain = RosDomain()
    rclpy.init(domain_id=domain.number)
    node = Node("listener")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    heard: list[tuple[str, bytes]] = []

    def listen(topics: dict[str, Any]) -> tuple[dict[str, str], list[tuple[str, bytes]]]:
        for topic, (kind, latched) in topics.items():
            durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
            node.create_subscription(
                kind,
                topic,
                lambda raw, t=topic: heard.append((t, raw)),
                QoSProfile(depth=500, durability=durability),
                raw=True,
            )
        return os.environ | {"ROS_DOMAIN_ID": str(domain.number)}, heard

    listen.spin = lambda: executor.spin_once(timeout_sec=0.02)  # type: ignore[attr-defined]
    yield listen
    rclpy.try_shutdown()
    domain.close()


@pytest.mark.graph
def test_a_subscriber_gets_every_byte_in_order_with_the_clock(bags: Path, listener: Any) -> None:
    from ds_interfaces.msg import VehicleState
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import Image
    from visualization_msgs.msg import MarkerArray

    wanted: dict[str, Any] = {
        "/twin/state": (VehicleState, False),
        "/twin/camera/image_raw": (Image, False),
        "/twin/road_markers": (MarkerArray, True),
    }
    environment, heard = listener(wanted | {"/clock": (Clock, False)})
    process = subprocess.Popen(
        [*DS, str(bags / "raw"), "--rate", "max", "--wait", "20", "--json"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    expected: dict[str, list[bytes]] = {}
    with BagReader(bags / "raw") as bag:
        for connection, _, raw in bag.messages():
            expected.setdefault(connection.topic, []).append(raw)
    total = sum(len(expected[topic]) for topic in wanted) + 41
    deadline = time.monotonic() + 60.0
    while len(heard) < total and time.monotonic() < deadline:
        listener.spin()
    out, err = process.communicate(timeout=120.0)
    assert process.returncode == 0, err
    for topic in wanted:
        got = [raw for name, raw in heard if name == topic]
        # DDS pads messages to four bytes.
        padded = [raw + bytes(-len(raw) % 4) for raw in expected[topic]]
        assert got == padded, topic
    document = json.loads(out)
    assert document["whole"] and document["seconds"] == pytest.approx(2.0)
    clocks = [struct.unpack_from("<iI", raw, 4) for name, raw in heard if name == "/clock"]
    assert [sec * 10**9 + nanosec for sec, nanosec in clocks] == [10**9 + step * 50 * MS for step in range(41)]


@pytest.mark.graph
def test_keys_of_a_terminal_pause_step_and_end(bags: Path) -> None:
    """A pseudo-terminal in which the right arrow is pressed twice, then q; the terminal is left as it was."""
    import pty
    import termios

    domain = RosDomain()
    master, slave = pty.openpty()
    before = termios.tcgetattr(slave)
    process = subprocess.Popen(
        [*DS, str(bags / "telemetry"), "--rate", "0.01", "--wait", "0", "--json"],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain.number)},
        stdin=slave,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    said = []
    for line in process.stderr:
        said.append(line)
        if line.startswith("space pauses"):
            time.sleep(0.3)
            os.write(master, b" ")
        elif line.startswith("paused"):
            os.write(master, b"\x1b[C")
        elif line.startswith("0.050 s"):
            os.write(master, b"s")
        elif line.startswith("0.100 s"):
            os.write(master, b"q")
    out = process.communicate(timeout=120.0)[0]
    after = termios.tcgetattr(slave)
    os.close(master)
    os.close(slave)
    domain.close()
    assert process.returncode == 0, said
    document = json.loads(out)
    assert (document["moments"], document["whole"]) == (3, False)
    assert after == before
