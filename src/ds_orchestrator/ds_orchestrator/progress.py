"""A campaign's progress on a person's screen: stage, tests done, failures so far, time left."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ds_orchestrator.store import Execution, Test


class ScreenWatcher:
    """Draws a progress bar on standard error, or writes a line now and then where there is no terminal.

    Args:
        total: executions of the whole campaign.
    """

    def __init__(self, total: int) -> None:
        self._console = Console(stderr=True)
        self._total = total
        self._done = 0
        self._failures = 0
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[failures]} failures"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("starting", total=total, failures=0)

    def __enter__(self) -> ScreenWatcher:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def stage(self, name: str) -> None:
        """Show the stage."""
        self._progress.update(self._task, description=name)
        if not self._console.is_terminal:
            print(f"stage: {name}", file=sys.stderr, flush=True)

    def finished(self, test: Test, simulator: str, execution: Execution | None, fresh: bool) -> None:
        """Count an execution."""
        self._done += 1
        self._failures += execution is not None and execution.outcome.is_failure
        self._progress.update(self._task, advance=1, failures=self._failures)
        if not self._console.is_terminal and fresh:
            left = self._progress.tasks[0].time_remaining
            outcome = execution.outcome.name.lower() if execution else "error"
            time_left = f", about {left:.0f} s left" if left else ""
            print(
                f"{self._done}/{self._total} {test.test_id} on {simulator}: {outcome}{time_left}",
                file=sys.stderr,
                flush=True,
            )
