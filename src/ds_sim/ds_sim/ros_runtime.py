"""Runs one node in a process until it is told to stop, and stops cleanly whatever it is doing."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node


def run_node(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Make a node and spin it; the exit status is 0, or 2 when the node could not be made for bad input.

    SIGINT and SIGTERM end the loop within its time-out. A ValueError from `make_node` is told in one line.
    """
    rclpy.init(args=args)
    node: Node | None = None
    try:
        node = make_node()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok():
            executor.spin_once(timeout_sec=0.2)  # an untimed spin may hang on SIGTERM
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not interrupt the cleaning up
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
