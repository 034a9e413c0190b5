# SPDX-License-Identifier: Apache-2.0
"""What a verb of `ds` returns, how it is printed, and progress on standard error."""

from __future__ import annotations

import inspect
import json
import os
import stat
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ds_base.installation import as_typed
from ds_base.progress import Progress
from ds_base.words import duration

if TYPE_CHECKING:
    from ds_driver.control.command_habits import Habit

_JSON = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]
NOT_PASSED = 3
"""Exit status if a pass criterion is not met; 1 and 2 say that nothing was decided."""


class Interrupted(Exception):
    """The user stopped a verb; says what is kept and how to go on, empty if nothing was written."""


@contextmanager
def stopped(kept: Callable[[], str]) -> Iterator[None]:
    """Turn the user's stop into `Interrupted`, which says what is kept."""
    from ds_orchestrator.campaign.executor import Stopped

    try:
        yield
    except (KeyboardInterrupt, Stopped):
        raise Interrupted(kept()) from None


def stopped_in(folder: Path | None) -> AbstractContextManager[None]:
    """Turn the user's stop into `Interrupted`, which says where the finished drives are; nowhere if None."""
    return stopped(lambda: "" if folder is None else f"finished drives are in {folder}: the same command goes on")


@dataclass(frozen=True, kw_only=True)
class Result:
    """Result of a verb."""

    document: Any  # as JSON values
    show: Callable[[], None]  # prints it for a person, on standard output
    next: str  # command that a user types next, such as `ds report DIR`
    error: bool = False  # True if the exit status is to be 1
    # Pass criteria that are not met, one sentence each; with any, the exit status is 3 unless it is 1.
    unmet: Sequence[str] = ()


def say(line: str) -> None:
    """Print a line of progress."""
    print(line.encode("utf-8", "backslashreplace").decode(), file=sys.stderr, flush=True)  # names need be no text


def say_next(command: str) -> None:
    """Print the command that a user types next, after everything else."""
    sys.stdout.flush()
    say(f"next: {as_typed(command)}")


def printed_to() -> str | None:
    """The file to which the shell has redirected standard output, as a path from here if it lies below; else None."""
    try:
        if not stat.S_ISREG(os.fstat(sys.stdout.fileno()).st_mode):
            return None
        return os.path.relpath(os.readlink(f"/proc/self/fd/{sys.stdout.fileno()}"))
    except OSError:  # no /proc, or no file at all, as where tests capture it
        return None


def warning(driver: str, habit: Habit) -> str:
    """One line about a driver's commands, with the command that tells more."""
    return f"warning: {driver}: {habit.text} See ds check {driver}"


KEPT = 0.05
"""Seconds an item; items reported faster than this at the start were done by an earlier call, and do not count for the
time left. Chosen: no drive is so short."""


class ScreenProgress(Progress):
    """Prints lines with what is done, and how long the rest takes at this pace; `every` so many seconds at most."""

    def __init__(self, now: Callable[[], float] = time.monotonic, every: float = 0.0) -> None:
        self._now, self._every, self._said = now, every, now()
        self.start(0)

    def start(self, total: float) -> None:
        """See `Progress.start`."""
        self._total, self._began, self._done, self._kept = total, self._now(), 0.0, 0.0

    def advance(self, amount: float = 1, line: str = "") -> None:
        """See `Progress.advance`."""
        self._done = min(self._done + amount, self._total)
        passed = self._now() - self._began
        if passed < KEPT * (self._done - self._kept) and passed < 1.0:
            self._kept = self._done
        if line and self._now() - self._said >= self._every:
            self.describe(line)

    def describe(self, line: str) -> None:
        """See `Progress.describe`."""
        share = (
            f"{self._done / self._total:.0%}" if isinstance(self._total, float) else f"{self._done:.0f}/{self._total}"
        )
        left = ""
        if self._kept < self._done < self._total:
            pace = (self._now() - self._began) / (self._done - self._kept)
            left = f"; about {duration(pace * (self._total - self._done))} left"
        self._said = self._now()
        say(f"{share} {line}{left}")


def number(value: float | None) -> str:
    """Format a value for a table; empty if there is none."""
    return "" if value is None else f"{value:.2f}"


def verb(app: typer.Typer, name: str) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Add a verb that returns a `Result`, which is then printed for a person, or as JSON.

    A parameter whose type is a dataclass stands for several options, the fields of that class. The exit status is 1 if
    the result is an error, and 3 if a pass criterion is not met.
    """

    def add(function: Callable[..., Result]) -> Callable[..., Result]:
        parameters: list[inspect.Parameter] = []
        groups: dict[str, tuple[Any, list[str]]] = {}
        for parameter in inspect.signature(function, eval_str=True).parameters.values():
            taken, kind = [parameter], parameter.annotation
            if isinstance(kind, type) and is_dataclass(kind):
                taken = list(inspect.signature(kind, eval_str=True).parameters.values())
                groups[parameter.name] = kind, [one.name for one in taken]
            parameters += taken
        parameters.append(inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_JSON))

        def command(as_json: bool, **values: Any) -> None:
            for group, (kind, names) in groups.items():
                values[group] = kind(**{one: values.pop(one) for one in names})
            end(function(**values), as_json)

        command.__doc__ = function.__doc__
        command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in parameters]
        )
        app.command(name)(command)
        return function

    return add


def end(result: Result, as_json: bool) -> None:
    """Print a result, and exit with status 1 if it is an error, with 3 if a pass criterion is not met."""
    if as_json:
        print(json.dumps(result.document, allow_nan=False))
    else:
        result.show()
    for sentence in result.unmet:
        say(f"not passed: {sentence}")
    if not result.error:
        say_next(result.next)
    if result.error or result.unmet:
        raise typer.Exit(1 if result.error else NOT_PASSED)
