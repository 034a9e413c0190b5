# SPDX-License-Identifier: Apache-2.0
"""A node spun in a thread of its own survives what rclpy's events executor dies of, and leaves nothing behind."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator

import pytest
from rclpy.context import Context
from rclpy.node import Node

from ds_orchestrator.graph.session import RosDomain
from ds_sim.ros.node_thread import NodeThread
from ds_sim.ros.runtime import init_ros

pytestmark = pytest.mark.graph


@pytest.fixture
def node() -> Iterator[Node]:
    domain, context = RosDomain(), Context()
    init_ros(context=context, domain_id=domain.number)
    node = Node("spun", context=context)
    yield node
    node.destroy_node()
    context.shutdown()
    domain.close()


def test_an_exception_in_a_task_ends_in_the_log(node: Node, capfd: pytest.CaptureFixture[str]) -> None:
    """ros2/rclpy issue 1641: without care the process ends with a segmentation fault."""

    def refuse() -> None:
        raise RuntimeError("two servers accepted the goal")

    thread = NodeThread(node)
    assert thread.call(refuse, 5.0) is None
    spun = threading.Event()
    assert thread.call(lambda: spun.set(), 5.0) is None and spun.is_set()  # type: ignore[arg-type,func-returns-value]
    assert thread.end()
    sys.stdout.flush()
    assert "RuntimeError: two servers accepted the goal" in capfd.readouterr().err
