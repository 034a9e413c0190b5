"""A campaign's progress on a person's screen: stage, tests done, failures so far, time left for all that drives."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ds_orchestrator.cli.eta import Eta
from ds_orchestrator.store.store import Execution, Test


class ScreenListener:
    """Draws a progress bar on standard error, or writes a line now and then where there is no terminal."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._lock = threading.Lock()
        self._total = 0
        self._done = 0
        self._failures = 0
        self._left = Eta()
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
        with self._lock:
            self._left.begin(time.monotonic())
        self._progress.update(self._task, description=name)
        if not self._console.is_terminal:
            print(f"stage: {name}", file=sys.stderr, flush=True)

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        """Take in how many executions there are in all."""
        with self._lock:
            self._left.expect(stages)
            self._total = sum(sum(stage.values()) for stage in stages)
        self._progress.update(self._task, total=self._total)

    def finished(self, test: Test, simulator: str, execution: Execution | None, fresh: bool) -> None:
        """Count an execution; what the store knew already took no time, so it does not count for the time left."""
        with self._lock:
            self._done += 1
            # A test is driven on its own sibling by the search, elsewhere by the stage after that.
            self._left.finished(int(test.sibling != simulator), simulator, time.monotonic(), fresh=fresh)
            self._failures += execution is not None and execution.outcome.is_failure
            left = self._time_left()
            self._progress.update(self._task, completed=self._done, failures=self._failures, left=left)
            if not self._console.is_terminal and fresh:
                outcome = execution.outcome.name.lower() if execution else "error"
                line = f"{self._done}/{self._total} {test.test_id} on {simulator}: {outcome}"
                print(line + (f", {left}" if left else ""), file=sys.stderr, flush=True)

    def _time_left(self) -> str:
        seconds = self._left.seconds()
        if seconds is None:
            return ""
        if seconds < 120:
            return f"about {seconds:.0f} s left"
        return f"about {seconds / 60:.0f} min left" if seconds < 7200 else f"about {seconds / 3600:.1f} h left"
