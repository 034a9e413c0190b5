# SPDX-License-Identifier: Apache-2.0
"""Measures waits without the time in which this process stood still."""

from __future__ import annotations

import threading
import time

LONGEST_LOOK = 3.0
"""Time between two looks at the clock beyond which this process stood still, s; chosen: a busy machine stays below."""


class RunningClock:
    """Monotonic clock that stands still with its process: stopped by a signal, or in a paused container or machine.

    Whoever waits for another process looks at it at least every `LONGEST_LOOK` s, and after a pause blames nobody for
    what this process could not hear.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._looked, self._paused = time.monotonic(), 0.0

    def now(self) -> float:
        """Time of the clock, s; a pause counts as `LONGEST_LOOK`."""
        with self._lock:
            at = time.monotonic()
            self._paused += max(0.0, at - self._looked - LONGEST_LOOK)
            self._looked = at
            return at - self._paused
