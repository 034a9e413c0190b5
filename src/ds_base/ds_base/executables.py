# SPDX-License-Identifier: Apache-2.0
"""Starts a node such that a signal ends it at once, silently and with status 0, even while its libraries load."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from functools import partial
from importlib import import_module
from types import FrameType

GRACE = 0.7
"""Seconds that a node gets after a signal to end by itself; chosen so that everything fits into a second."""


class Stop:
    """Handler of SIGINT and SIGTERM in the main thread.

    A signal ends the process at once while its nodes are being made (`making`); later it is only noted (`requested`),
    so that no callback ends halfway. A process that is still busy after a grace, s, in a library or in a simulator that
    hangs, says its last words and is ended. All with status 0: being stopped is no error, and `ros2 launch` reports
    `process has died` for any other.
    """

    def __init__(self, grace: float = GRACE, last_words: Callable[[], None] = lambda: None) -> None:
        self.making, self.requested = True, False
        self._grace, self._last_words = grace, last_words
        self._readable, writable = os.pipe()
        os.set_blocking(writable, False)
        # The C signal handler writes this, even while the main thread cannot run the Python handler.
        signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
        threading.Thread(target=self._end_in_time, name="stop", daemon=True).start()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True

    def _end_in_time(self) -> None:
        os.read(self._readable, 1)
        if not self.making:
            threading.Event().wait(self._grace)
            self._last_words()
            print(f"ended while still busy, {self._grace:g} s after the signal", file=sys.stderr, flush=True)
        os._exit(0)


def start(module: str, *arguments: str) -> None:
    """Import a node's module and call its `main`, which installs its own signal handlers."""
    Stop()
    import_module(module).main(*arguments)


simulator = partial(start, "ds_sim.ros.simulator_node")
"""Hosts the simulator that the parameter `simulator` names."""
bullet, panda, softbody, donkey, ros = (
    partial(simulator, name) for name in ("bullet", "panda", "softbody", "donkey", "ros")
)
"""Host this simulator unless the parameter names another one; `ros` needs one that names a file, `ros@FILE`."""
