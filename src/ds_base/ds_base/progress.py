# SPDX-License-Identifier: Apache-2.0
"""How far a piece of work is, and lines about it: who works reports, whoever called decides what is shown.

Lines go to the logger `digital_siblings` of the standard library, which shows nothing below a warning unless asked:

    logging.basicConfig(format="%(message)s")
    logging.getLogger(LOGGER).setLevel(logging.INFO)
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

LOGGER = "digital_siblings"
"""Name of the logger above those of all modules."""


def logger_of(module: str) -> logging.Logger:
    """The logger of a module, given its `__name__`."""
    return logging.getLogger(f"{LOGGER}.{module}")


class _LinesTo(logging.Handler):
    def __init__(self, receive: Callable[[str], object]) -> None:
        super().__init__()
        self._receive = receive

    def emit(self, record: logging.LogRecord) -> None:
        self._receive(record.getMessage())


@contextmanager
def lines_to(receive: Callable[[str], object]) -> Iterator[None]:
    """Hand the lines of the product's loggers to a function while the context lasts."""
    handler, logger = _LinesTo(receive), logging.getLogger(LOGGER)
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


EVERY = 5.0
"""Seconds between two lines about work that nobody asked to hear of; chosen: what a person waits without doubt."""
_Item = TypeVar("_Item")


def counted(items: Iterable[_Item], what: str) -> Iterator[_Item]:
    """Pass images of something on, with a line about how many there were every `EVERY` seconds."""
    said = time.monotonic()
    for number, item in enumerate(items):
        if time.monotonic() - said >= EVERY:
            said = time.monotonic()
            logger_of(__name__).info("%s: %d images read", what, number)
        yield item


class Progress:
    """Receives how far a piece of work is, from one thread; this one ignores it.

    progress.start(len(roads))
    for road in roads:
        drive(road)
        progress.advance(line=f"{road.road_id} driven")
    """

    def start(self, total: float) -> None:
        """Begin: an `int` counts items, a `float` is an amount of work in any unit. Begin again for other work."""

    def advance(self, amount: float = 1, line: str = "") -> None:
        """Count work as done, and say something about it if there is a line."""

    def describe(self, line: str) -> None:
        """Say what is being done, or was found, while no item ends."""


SILENT = Progress()
