# SPDX-License-Identifier: Apache-2.0
"""Runs nodes in a process until a signal stops them, within a second whatever the nodes are doing."""

from __future__ import annotations

import inspect
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

import rclpy
import rclpy.task
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ds_base.errors import InputError
from ds_base.executables import GRACE, Stop

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # rclpy before 7.1.5 has none
    EventsExecutor = SingleThreadedExecutor

SPIN_TIME = 0.1
"""Longest wait of an executor before it looks for a signal, s; the events executor ignores a time-out of None."""


class LogFolderError(InputError):
    """ROS 2 has no writable folder for its logs."""


def init_ros(**arguments: Any) -> None:
    """Call `rclpy.init` without its signal handlers, and keep Fast DDS from using shared memory.

    A peer that is killed with the lock of this process's shared-memory port makes this process hang or crash when it
    ends, see `ds_bringup/config/fastdds_loopback.xml`, which holds unless the user has chosen another discovery.
    LogFolderError if the home folder is not writable, and ROS_LOG_DIR names no other folder.
    """
    os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO, **arguments)
    except RuntimeError as error:
        if "log" not in str(error):
            raise
        reason = str(error).partition(", at ")[0]
        raise LogFolderError(f"{reason}: set ROS_LOG_DIR to a folder that can be written") from None


def make_executor(context: Context | None = None) -> Executor:
    """Make the fastest executor that this rclpy has; spin it with a time-out.

    `SingleThreadedExecutor` builds its wait set anew, in Python, for every message: 350 us of processor time, where
    `EventsExecutor` takes 30.
    """
    kept, rclpy.task.Task = rclpy.task.Task, _LoggedTask  # type: ignore[misc]
    try:
        return EventsExecutor(context=context)  # looks the class of its tasks up once, here
    finally:
        rclpy.task.Task = kept  # type: ignore[misc]


class _LoggedTask(rclpy.task.Task):
    """Task whose exception ends in the log, and whose result then is None.

    The events executor of rclpy 7.1 crashes the process on an exception in a task, where it indexes a set with a null
    pointer (ros2/rclpy issue 1641). rclpy's action client raises one if two servers accept a goal, as two simulators
    in one namespace do.
    """

    def __call__(self) -> None:
        super().__call__()
        if self.done() and (error := super().exception()) is not None:
            get_logger("ds_sim").error(f"{type(error).__name__}: {error}")

    def exception(self) -> None:
        """None: the executor must not see it."""

    def result(self) -> Any:
        """Result of the handler; None if it raised."""
        return None if super().exception() is not None else super().result()


def with_info(callback: Callable[[Any, dict[str, Any]], None]) -> Callable[..., None]:
    """Wrap a subscription's callback that takes the message's information too.

    The events executor of rclpy 7.1 passes both as one tuple, and every other executor as two arguments.
    """

    def call(*received: Any) -> None:
        message, info = received if len(received) == 2 else received[0]
        callback(message, info)

    call.__signature__ = inspect.signature(callback)  # type: ignore[attr-defined]
    return call


_failures: list[BaseException] = []


def end_with(error: ValueError) -> None:
    """End the nodes of this process after the present callback, with one line and status 2.

    An exception in a callback does the same, but the events executor logs its traceback first.
    """
    _failures.append(error)


def _spin(node: Node, stop: Stop) -> None:
    executor = make_executor()
    executor.add_node(node)
    try:
        while rclpy.ok() and not stop.requested and not _failures:
            executor.spin_once(timeout_sec=SPIN_TIME)
    finally:
        executor.shutdown()  # lets go of the node, which is destroyed next


def _spin_beside(node: Node, stop: Stop) -> None:
    try:
        _spin(node, stop)
    except ExternalShutdownException:
        pass
    except BaseException as error:
        _failures.append(error)


def _spin_all(nodes: list[Node], stop: Stop) -> None:
    """Spin the first node in this thread, and each other one in a thread of its own, until a signal or an error."""
    threads = [
        threading.Thread(target=_spin_beside, args=(node, stop), name=node.get_name(), daemon=True)
        for node in nodes[1:]
    ]
    for thread in threads:
        thread.start()
    try:
        _spin(nodes[0], stop)
    finally:
        stop.requested = True
        for thread in threads:
            thread.join(GRACE)
    if _failures:
        raise _failures.pop()


def run_node(*make_nodes: Callable[[], Node]) -> int:
    """Make nodes and spin them; the exit status is 0, or 2 when a node could not be made, or ended, for bad input.

    SIGINT and SIGTERM end them within a second, with status 0. A ValueError is printed in one line. Each node has a
    thread of its own, so that one answers while another computes.
    """
    stop = Stop()
    nodes: list[Node] = []
    try:
        init_ros()
        for make_node in make_nodes:
            nodes.append(make_node())
        stop.making = False
        _spin_all(nodes, stop)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except ExternalShutdownException:
        pass
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
        # `ros2 launch` repeats the terminal's Ctrl-C, which would kill an interpreter that takes down its handlers.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return 0
