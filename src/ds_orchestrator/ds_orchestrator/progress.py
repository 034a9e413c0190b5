"""A campaign's progress on a person's screen: stage, tests done, failures so far, time left for all that drives."""

from __future__ import annotations

import sys
import threading
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ds_orchestrator.store import Execution, Test


class ScreenWatcher:
    """Draws a progress bar on standard error, or writes a line now and then where there is no terminal."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._lock = threading.Lock()
        self._total = 0
        self._done = 0
        self._fresh = 0
        self._failures = 0
        self._started = time.monotonic()
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

    def __enter__(self) -> ScreenWatcher:
        self._progress.start()
        self._started = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def stage(self, name: str) -> None:
        """Show the stage."""
        self._progress.update(self._task, description=name)
        if not self._console.is_terminal:
            print(f"stage: {name}", file=sys.stderr, flush=True)

    def expect(self, executions: int) -> None:
        """Take in how many executions there are in all."""
        self._total = executions
        self._progress.update(self._task, total=executions)

    def finished(self, test: Test, simulator: str, execution: Execution | None, fresh: bool) -> None:
        """Count an execution; what the store knew already took no time, so it does not count for the time left."""
        with self._lock:
            self._done += 1
            self._fresh += fresh
            self._failures += execution is not None and execution.outcome.is_failure
            left = self._time_left()
            self._progress.update(self._task, completed=self._done, failures=self._failures, left=left)
            if not self._console.is_terminal and fresh:
                outcome = execution.outcome.name.lower() if execution else "error"
                line = f"{self._done}/{self._total} {test.test_id} on {simulator}: {outcome}"
                print(line + (f", {left}" if left else ""), file=sys.stderr, flush=True)

    def _time_left(self) -> str:
        if not self._fresh:
            return ""
        seconds = (time.monotonic() - self._started) / self._fresh * max(self._total - self._done, 0)
        if seconds < 120:
            return f"about {seconds:.0f} s left"
        return f"about {seconds / 60:.0f} min left" if seconds < 7200 else f"about {seconds / 3600:.1f} h left"
