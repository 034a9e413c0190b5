# SPDX-License-Identifier: Apache-2.0
"""Progress on standard error: of a campaign, and of one drive."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ds_base.words import duration
from ds_cli.output import say
from ds_orchestrator.campaign.engine import Watch
from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.time_left import TimedListener
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName

EVERY = 5.0
"""Seconds between two lines about a drive where there is no terminal; chosen."""


class ScreenListener(TimedListener):
    """Shows a campaign's stage, executions, failures and time left: a bar on a terminal, lines elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self._console = Console(stderr=True)
        self._failures = 0
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[failures]} failures"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("starting", total=None, failures=0, left="")

    def __enter__(self) -> ScreenListener:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def stage(self, name: str) -> None:
        """Show the stage."""
        super().stage(name)
        self._progress.update(self._task, description=name)
        if not self._console.is_terminal:
            say(f"stage: {name}")

    def expect(self, stages: Sequence[Mapping[SimulatorName, int]]) -> None:
        """Set the number of executions of each stage on each simulator."""
        super().expect(stages)
        self._progress.update(self._task, total=self.total)

    def finished(self, test: Test, simulator: SimulatorName, execution: Execution | Gate | None, fresh: bool) -> None:
        """Count an execution; one that was in the store took no time, so it does not count for the time left."""
        with self._lock:
            super().finished(test, simulator, execution, fresh)
            self._failures += isinstance(execution, Execution) and execution.outcome.is_failure
            seconds = self.seconds_left()
            left = "" if seconds is None else f"about {duration(seconds)} left"
            self._progress.update(self._task, completed=self.done, failures=self._failures, left=left)
            if not self._console.is_terminal and fresh:
                outcome = _outcome(execution)
                line = f"{self.done}/{self.total} {test.test_id} on {simulator.in_words}: {outcome}"
                say(line + (f", {left}" if left else ""))


class StageLines(Listener):
    """Prints the stages of what is computed after driving."""

    def stage(self, name: str) -> None:
        """Print the stage."""
        say(f"stage: {name}")


def _outcome(execution: Execution | Gate | None) -> str:
    if isinstance(execution, Gate):
        return f"{execution.state.value}, {execution.message}"
    return execution.outcome.name.lower() if execution else "error"


@contextmanager
def drive_progress(description: str) -> Iterator[Watch]:
    """Show how far a drive is along its road: a bar on a terminal, a line now and then elsewhere; yields its watch."""
    console, said = Console(stderr=True), time.monotonic()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f}%"),
        TextColumn("{task.fields[state]}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(description, total=1.0, state="")

        def watch(step: int, driven: float, lateral_position: float) -> None:
            nonlocal said
            state = f"frame {step}, {lateral_position:+.2f} m off the lane's centre"
            progress.update(task, completed=driven, state=state)
            if not console.is_terminal and time.monotonic() - said >= EVERY:
                said = time.monotonic()
                say(f"{description}: {driven:.0%}, {state}")

        yield watch
