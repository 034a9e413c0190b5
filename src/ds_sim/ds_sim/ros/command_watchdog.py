"""How long a simulator waits for its driver, by the wall clock; it decides when to give up, never what a result is."""

from __future__ import annotations

import time

REPEAT_AFTER = 0.5
"""Seconds after which an unanswered first frame is sent again, for a driver that was not connected yet."""


class CommandWatchdog:
    """Watches the wait for a driver.

    Args:
        limit: seconds that a driver gets for an answer.
        frames_wait: a frame waits for its answer, so each frame begins a new wait; in real time none does.
    """

    def __init__(self, limit: float, *, frames_wait: bool = True) -> None:
        self.limit = limit
        self._frames_wait = frames_wait
        self._repeatable = True
        self._asked = self._sent = time.monotonic()

    def sent(self, step: int) -> None:
        """A frame was sent; a first frame that is sent again does not give its driver more time."""
        self._sent = time.monotonic()
        self._repeatable = step == 0
        if self._frames_wait and not self._repeatable:
            self._asked = self._sent

    def heard(self) -> None:
        """A command came."""
        self._asked = time.monotonic()
        self._repeatable = False

    @property
    def is_over(self) -> bool:
        """True when the driver was silent for too long."""
        return time.monotonic() - self._asked > self.limit

    @property
    def wants_repeat(self) -> bool:
        """True when a first frame should be sent again."""
        return self._repeatable and time.monotonic() - self._sent > REPEAT_AFTER
