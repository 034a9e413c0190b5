"""How a command is told to stop: Ctrl-C, SIGTERM and a closed terminal all interrupt it in the same way."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_heard = [signal.SIGINT]


def listen() -> None:
    """Let the signals raise KeyboardInterrupt in the main thread; one that is ignored stays so, as nohup wants it."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)


def exit_status() -> int:
    """Of a command that was stopped, as shells have it: 130 for Ctrl-C, 143 for SIGTERM."""
    return 128 + _heard[-1]


def _interrupt(number: int, _: FrameType | None) -> NoReturn:
    _heard.append(signal.Signals(number))
    raise KeyboardInterrupt


class IgnoreSignals:
    """Within it nothing interrupts, however often Ctrl-C is pressed: for cleaning up."""

    def __init__(self) -> None:
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> IgnoreSignals:
        self._before = {number: signal.signal(number, signal.SIG_IGN) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
