"""Single keys from a terminal, without waiting for a line."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ds_bags.player import PAUSE, QUIT, STEP

KEYS = {" ": PAUSE, "s": STEP, "\x1b[C": STEP, "q": QUIT}
"""What a terminal sends -> what it means; the third is the right arrow."""


@contextmanager
def player_keys() -> Iterator[Callable[[float], str]]:
    """A function that waits at most so many seconds and gives the key that came; without a terminal it only waits."""
    if not sys.stdin.isatty():
        yield _sleep
        return
    file = sys.stdin.fileno()
    before = termios.tcgetattr(file)

    def wait(seconds: float) -> str:
        if not select.select([file], [], [], seconds)[0]:
            return ""
        return KEYS.get(os.read(file, 16).decode(errors="replace").lower().replace("\x1b[c", "\x1b[C"), "")

    try:
        tty.setcbreak(file)  # Ctrl-C still interrupts
        yield wait
    finally:
        termios.tcsetattr(file, termios.TCSADRAIN, before)


def _sleep(seconds: float) -> str:
    time.sleep(seconds)
    return ""
