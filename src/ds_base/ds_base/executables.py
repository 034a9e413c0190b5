# SPDX-License-Identifier: Apache-2.0
"""Starts a node such that a signal ends it at once, silently and with status 0, even while its libraries load."""

from __future__ import annotations

import os
import signal
import threading
from functools import partial
from importlib import import_module
from types import FrameType


def start(module: str, *arguments: str) -> None:
    """Import a node's module and call its `main`, which installs its own signal handlers.

    `ros2 launch` reports `process has died` for any status but 0, and being stopped during start-up is no error.
    """
    readable, writable = os.pipe()
    os.set_blocking(writable, False)
    # Python calls a handler between two bytecodes only; C writes the wake-up byte at once.
    signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
    threading.Thread(target=_exit_on_signal, args=(readable,), name="start", daemon=True).start()
    # Last: a signal that is caught before its byte can be written would be lost.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave_to_thread)
    import_module(module).main(*arguments)


simulator = partial(start, "ds_sim.ros.simulator_node")
"""Hosts the simulator that the parameter `simulator` names."""
bullet, panda, softbody, donkey, ros = (
    partial(simulator, name) for name in ("bullet", "panda", "softbody", "donkey", "ros")
)
"""Host this simulator unless the parameter names another one; `ros` needs one that names a file, `ros@FILE`."""


def _leave_to_thread(_number: int, _frame: FrameType | None) -> None:
    """Ignore the signal: the thread reads its wake-up byte."""


def _exit_on_signal(readable: int) -> None:
    """End the process at the first signal; before a node exists, nothing has to be cleaned up."""
    os.read(readable, 1)
    os._exit(0)
