# SPDX-License-Identifier: Apache-2.0
"""Messages of one topic, in the order of their arrival, for another thread that waits for one of them."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

MOST = 200
"""Messages that are kept; chosen: a frame of a simulator that publishes 4000 times a second."""


@dataclass(frozen=True, slots=True)
class Received:
    """A message, the stamp of its header, ns, and its arrival by the monotonic clock, s."""

    stamp: int
    arrived: float
    message: Any


class Inbox:
    """Keeps the newest messages of one topic."""

    def __init__(self) -> None:
        self._messages: deque[Received] = deque(maxlen=MOST)
        self._changed = threading.Condition()

    def put(self, message: Any) -> None:
        """Add a message; called by the node's thread."""
        stamp = message.header.stamp
        received = Received(stamp.sec * 10**9 + stamp.nanosec, time.monotonic(), message)
        with self._changed:
            self._messages.append(received)
            self._changed.notify_all()

    def clear(self) -> None:
        """Forget all messages."""
        with self._changed:
            self._messages.clear()

    @property
    def newest(self) -> Received | None:
        """The last message to arrive."""
        with self._changed:
            return self._messages[-1] if self._messages else None

    def wait(self, stamp: int, deadline: float) -> Received | None:
        """Return the first message with a stamp (ns) or a later one; None at a deadline of the monotonic clock, s."""

        def found() -> Received | None:
            return next((one for one in self._messages if one.stamp >= stamp), None)

        with self._changed:
            return self._changed.wait_for(found, max(0.0, deadline - time.monotonic()))
