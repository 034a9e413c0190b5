"""Runs one node in a process until a signal stops it, within a second whatever the node is doing."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

GRACE = 0.7
"""Seconds that a node gets after a signal to end by itself; chosen so that everything fits into a second."""


class Stop:
    """Handler of SIGINT and SIGTERM in the main thread.

    A signal interrupts the construction of the node; later it is only noted, so that no callback ends halfway. A
    process that is still busy after `GRACE`, in a library or in a simulator that hangs, is ended.
    """

    def __init__(self) -> None:
        self.requested = False
        self.interrupts = True
        self._readable, writable = os.pipe()
        os.set_blocking(writable, False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        # The C signal handler writes this, even while the main thread cannot run the Python handler.
        signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
        threading.Thread(target=self._end_in_time, name="stop", daemon=True).start()

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True
        if self.interrupts:
            self.interrupts = False
            raise KeyboardInterrupt

    def _end_in_time(self) -> None:
        number = os.read(self._readable, 1)[0]
        threading.Event().wait(GRACE)
        print(f"ended while still busy, {GRACE:g} s after the signal", file=sys.stderr, flush=True)
        os._exit(128 + number)


class LogFolderError(ValueError):
    """ROS 2 has no writable folder for its logs."""


def init_ros(**arguments: Any) -> None:
    """Call `rclpy.init` without its signal handlers.

    Args:
        arguments: arguments of `rclpy.init`.

    Raises:
        LogFolderError: the home folder is not writable, and ROS_LOG_DIR names no other folder.
    """
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO, **arguments)
    except RuntimeError as error:
        if "log" not in str(error):
            raise
        reason = str(error).partition(", at ")[0]
        raise LogFolderError(f"{reason}: set ROS_LOG_DIR to a folder that can be written") from None


def run_node(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Make a node and spin it; the exit status is 0, or 2 when the node could not be made for bad input.

    SIGINT and SIGTERM end it within a second. A ValueError is printed in one line.
    """
    stop = Stop()
    node: Node | None = None
    try:
        # rclpy's own handlers would shut the context down while the node is being created.
        init_ros(args=args)
        node = make_node()
        stop.interrupts = False
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok() and not stop.requested:
            executor.spin_once(timeout_sec=0.1)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        stop.interrupts = False  # a second Ctrl-C must not interrupt the cleanup
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
