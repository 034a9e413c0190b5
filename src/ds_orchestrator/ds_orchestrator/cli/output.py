"""What a verb of `ds` answers: a result for a person or as JSON, one exit status, progress on standard error."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import typer


class Interrupted(Exception):
    """The user stopped a command."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a verb found out.

    Attributes:
        document: as JSON values.
        show: shows it to a person, on standard output.
        error: True if a run ended in an error.
    """

    document: Any
    show: Callable[[], None]
    error: bool = False


def say(line: str) -> None:
    """A line of progress."""
    print(line, file=sys.stderr, flush=True)


def countdown() -> Callable[[int, int, str], None]:
    """Says what is done, and for how long it will go on if it goes on like this."""
    started = time.monotonic()

    def progress(done: int, total: int, line: str) -> None:
        left = (time.monotonic() - started) / done * (total - done)
        say(f"{done}/{total} {line}; about {left:.0f} s left")

    return progress


def number(value: float | None) -> str:
    """For a table; empty if there is none."""
    return "" if value is None else f"{value:.2f}"


def answer(result: Result, as_json: bool) -> None:
    """Show a result to a person, or print it as JSON."""
    if as_json:
        print(json.dumps(result.document, allow_nan=False))
    else:
        result.show()


def end(result: Result, as_json: bool) -> None:
    """Show a result, and end with status 1 if a run ended in an error."""
    answer(result, as_json)
    if result.error:
        raise typer.Exit(1)
