"""Runs one node in a process until it is told to stop, and stops within a second whatever it is doing."""

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
"""Seconds after a signal in which a node may come to an end by itself; chosen so that a second holds it all."""


class Stop:
    """Listens for SIGINT and SIGTERM in the main thread.

    While the node is made, a signal interrupts it; later it is noted, so that no callback ends halfway. Whatever is
    still busy after `GRACE`, in a library or in a simulator that hangs, is ended with its process.
    """

    def __init__(self) -> None:
        self.asked = False
        self.interrupts = True
        self._readable, writable = os.pipe()
        os.set_blocking(writable, False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)
        # The wake-up is written by C's signal handler, also while the main thread never gets to its Python handler.
        signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
        threading.Thread(target=self._end_in_time, name="stop", daemon=True).start()

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True
        if self.interrupts:
            self.interrupts = False
            raise KeyboardInterrupt

    def _end_in_time(self) -> None:
        number = os.read(self._readable, 1)[0]
        threading.Event().wait(GRACE)
        print(f"stopped in the midst of its work {GRACE:g} s after the signal", file=sys.stderr, flush=True)
        os._exit(128 + number)


class LogFolderError(ValueError):
    """ROS 2 has no folder for its logs that it can write."""


def init_ros(**arguments: Any) -> None:
    """Call `rclpy.init` without its signal handlers.

    Args:
        arguments: of `rclpy.init`.

    Raises:
        LogFolderError: the home folder cannot be written, and no other one is named.
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

    SIGINT and SIGTERM end it within a second. A ValueError from `make_node` is told in one line.
    """
    stop = Stop()
    node: Node | None = None
    try:
        # rclpy's own handlers would take the context from under a node that is still being made.
        init_ros(args=args)
        node = make_node()
        stop.interrupts = False
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok() and not stop.asked:
            executor.spin_once(timeout_sec=0.1)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        stop.interrupts = False  # a second Ctrl-C must not interrupt the cleaning up
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
