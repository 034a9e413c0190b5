# SPDX-License-Identifier: Apache-2.0
"""A killed graph leaves nothing in shared memory, and nothing but the document reaches standard output."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from ds_road import Road

pytestmark = pytest.mark.graph

STRAIGHT = Road([(125.0, 25.0 * i) for i in range(4)])
PROFILE = Path.cwd() / "src/ds_bringup/config/fastdds_loopback.xml"
LIMIT = 60.0
"""Longest wait for a graph, s."""
NODE = """
from ds_sim.ros.runtime import init_ros
init_ros()
from rclpy.node import Node
node = Node("node")
print(*(line for line in open("/proc/self/maps") if "/dev/shm/fastrtps" in line))
"""


@pytest.fixture
def road(tmp_path: Path) -> Path:
    path = tmp_path / "road.json"
    path.write_text(json.dumps(STRAIGHT.control_points))
    return path


def drive(road: Path, **environment: str) -> subprocess.Popen[str]:
    command = ["drive", "--sim", "donkey", "--driver", "autopilot", "--road", str(road), "--json"]
    return subprocess.Popen(
        [sys.executable, "-m", "ds_cli.main", *command],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def read_each(pid: int, pattern: str, read: Callable[[Path], str] = Path.read_text) -> Iterator[str]:
    """Read what a process has in /proc, without what ends between listing and reading: threads and open files do."""
    for path in Path(f"/proc/{pid}").glob(pattern):
        with suppress(FileNotFoundError, ProcessLookupError):
            yield read(path)


def children(pid: int) -> list[int]:
    """List the child processes of a process, whichever of its threads started them."""
    return [int(child) for text in read_each(pid, "task/*/children") for child in text.split()]


def dds_transports(pid: int) -> set[str]:
    """Name the transports of Fast DDS in a process, `udp` or `shm`, by the threads that receive."""
    names = read_each(pid, "task/*/comm")
    return {name.split(".")[1] for name in names if name.startswith(("dds.udp", "dds.shm"))}


def shared_memory(pid: int) -> list[str]:
    """List the files of Fast DDS in shared memory that a process maps or has open."""
    links = list(read_each(pid, "fd/*", os.readlink))
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return [name for name in links + lines if "/dev/shm/" in name and "fastrtps" in name]


def test_a_killed_graph_leaves_nothing(road: Path) -> None:
    """What a process leaves in shared memory when it is killed, it has mapped or open before."""
    killed, deadline = drive(road), time.monotonic() + LIMIT
    graph, transports = [killed.pid], [set[str]()]
    while len(graph) < 2 or not all(transports):
        assert killed.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
        graph = [killed.pid, *children(killed.pid)]
        transports = [dds_transports(pid) for pid in graph]
    left = [name for pid in graph for name in shared_memory(pid)]
    for pid in graph:
        os.kill(pid, signal.SIGKILL)
    assert killed.communicate(timeout=LIMIT)[0] == ""
    assert all(used == {"udp"} for used in transports) and not left


@pytest.mark.long
def test_a_paused_graph_goes_on(road: Path) -> None:
    """As `docker pause` does it; ROS forgets a node after 20 s."""
    road.write_text(json.dumps([(125.0, 25.0 * i) for i in range(9)]))
    paused = drive(road)
    while len(graph := [paused.pid, *children(paused.pid)]) < 2 or not all(map(dds_transports, graph)):
        assert paused.poll() is None
        time.sleep(0.02)
    time.sleep(2.0)
    for stop in (signal.SIGSTOP, signal.SIGCONT):
        for pid in graph:
            os.kill(pid, stop)
        if stop == signal.SIGSTOP:
            time.sleep(40.0)
    assert json.loads(paused.communicate(timeout=LIMIT)[0])["outcome"] == "COMPLETED"


def test_what_a_library_prints_does_not_reach_standard_output(road: Path, tmp_path: Path) -> None:
    """Fast DDS logs its errors there, here that a profile has the same name as another one; both are valid."""
    valid = PROFILE.read_text()
    begin, end = valid.index("<participant "), valid.index("</profiles>")
    profile = tmp_path / "profile.xml"
    profile.write_text(valid[:end] + valid[begin:])
    out, err = drive(road, FASTRTPS_DEFAULT_PROFILES_FILE=str(profile)).communicate(timeout=LIMIT)
    assert "Error adding profile" in err
    assert json.loads(out)["outcome"] == "COMPLETED"


def test_a_wider_discovery_range_brings_no_shared_memory_back() -> None:
    """The profile of one machine does not hold then."""
    chosen = os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    chosen.pop("FASTRTPS_DEFAULT_PROFILES_FILE", None)
    done = subprocess.run([sys.executable, "-c", NODE], env=chosen, capture_output=True, text=True, timeout=LIMIT)
    assert (done.stdout.strip(), done.returncode) == ("", 0), done.stderr
