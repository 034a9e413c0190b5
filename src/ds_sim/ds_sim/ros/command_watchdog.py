"""Wall-clock timeout for driver commands; it decides when a run is given up, never what a result is."""

from __future__ import annotations

import time

REPEAT_AFTER = 0.5
"""Time after which an unanswered first frame is sent again, s, for a driver that was not yet connected."""


class CommandWatchdog:
    """Measures the wait for a driver.

    Args:
        limit: longest wait for an answer, s.
        frames_wait: True in lock-step, where each frame begins a new wait; False in real time.
    """

    def __init__(self, limit: float, *, frames_wait: bool = True) -> None:
        self.limit = limit
        self._frames_wait = frames_wait
        self._repeatable = True
        self._asked = self._sent = time.monotonic()

    def sent(self, step: int) -> None:
        """Note that a frame was sent; a first frame that is sent again gives its driver no more time."""
        self._sent = time.monotonic()
        self._repeatable = step == 0
        if self._frames_wait and not self._repeatable:
            self._asked = self._sent

    def heard(self) -> None:
        """Note that a command came."""
        self._asked = time.monotonic()
        self._repeatable = False

    @property
    def is_over(self) -> bool:
        """True when the driver has been silent for too long."""
        return time.monotonic() - self._asked > self.limit

    @property
    def wants_repeat(self) -> bool:
        """Check whether the first frame should be sent again."""
        return self._repeatable and time.monotonic() - self._sent > REPEAT_AFTER
