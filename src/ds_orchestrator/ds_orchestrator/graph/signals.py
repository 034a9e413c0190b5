# SPDX-License-Identifier: Apache-2.0
"""Signal handling of commands: Ctrl-C, SIGTERM and a closed terminal all raise KeyboardInterrupt."""

from __future__ import annotations

import signal
import time
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_received = [signal.SIGINT]
_SAME = 1.0
"""Time in which the same signal is no second one, s: `ros2 launch` repeats the Ctrl-C that the terminal has sent."""
_last = float("-inf")


def listen() -> None:
    """Let the signals raise KeyboardInterrupt in the main thread; an ignored one stays ignored, as nohup requires."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)


def exit_status() -> int:
    """Exit status of an interrupted command by the shells' convention: 130 for Ctrl-C, 143 for SIGTERM."""
    return 128 + _received[-1]


def _interrupt(number: int, _: FrameType | None) -> None:
    global _last
    before, _last = _last, time.monotonic()
    if number != _received[-1] or _last - before > _SAME:
        _received.append(signal.Signals(number))
        raise KeyboardInterrupt


class IgnoreSignals:
    """Context in which SIGINT, SIGTERM and SIGHUP are ignored, for cleaning up."""

    def __init__(self) -> None:
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> IgnoreSignals:
        self._before = {number: signal.signal(number, signal.SIG_IGN) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
