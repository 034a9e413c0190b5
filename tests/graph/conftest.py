# SPDX-License-Identifier: Apache-2.0
"""Fixtures for graphs of real nodes in real processes, each in a separate ROS domain."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ds_base.processes import ChildProcesses


@pytest.fixture
def spin() -> Iterator[Callable[..., None]]:
    """Spin nodes of the test's process in the background."""
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    threads = []
    stop = threading.Event()

    def start(*nodes: object) -> None:
        executor = SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)

        def work() -> None:
            try:
                while rclpy.ok() and not stop.is_set():
                    executor.spin_once(timeout_sec=0.1)
            except ExternalShutdownException:
                pass

        threads.append(threading.Thread(target=work, daemon=True))
        threads[-1].start()

    yield start
    stop.set()
    for thread in threads:
        thread.join(2.0)


@pytest.fixture
def join() -> Iterator[Callable[[int], None]]:
    """Let nodes of the test's process join the graph of a ROS domain, whose client has a separate context."""
    import rclpy

    yield lambda domain: rclpy.init(domain_id=domain)
    rclpy.try_shutdown()
    gc.collect()  # entities in a reference cycle keep the participant, and with it shared memory of its domain


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    return folder


@pytest.fixture
def ended_with_this() -> Iterator[ChildProcesses]:
    """Starts processes that never outlive the test's: a node left behind would disturb another graph."""
    children = ChildProcesses()
    yield children
    children.close()
