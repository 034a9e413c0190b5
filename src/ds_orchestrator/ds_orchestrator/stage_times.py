"""How long the stages of a campaign took by the wall clock, over all sessions: told to people, it decides nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

from ds_orchestrator.campaign import Watcher
from ds_orchestrator.store import Execution, Store, Test

_PREFIX = "seconds "


class StageClock:
    """Hands everything on to another watcher, and adds up in the store how long each stage takes.

    Args:
        watcher: is told everything.
        store: keeps the seconds.
        clock: seconds since some moment.
    """

    def __init__(self, watcher: Watcher, store: Store, clock: Callable[[], float] = time.monotonic) -> None:
        self._watcher = watcher
        self._store = store
        self._clock = clock
        self._name = ""
        self._began = 0.0

    def stage(self, name: str) -> None:
        """See `Watcher.stage`."""
        self.end()
        self._name, self._began = name, self._clock()
        self._watcher.stage(name)

    def end(self) -> None:
        """The stage under way ends; without one nothing happens."""
        if self._name:
            self._store.add_seconds(self._name, self._clock() - self._began)
        self._name = ""

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        """See `Watcher.expect`."""
        self._watcher.expect(stages)

    def finished(self, test: Test, simulator: str, execution: Execution | None, fresh: bool) -> None:
        """See `Watcher.finished`."""
        self._watcher.finished(test, simulator, execution, fresh)


def seconds_of(notes: Mapping[str, str]) -> dict[str, float]:
    """Stage -> seconds, from what a store notes; longest first."""
    found = {key.removeprefix(_PREFIX): float(value) for key, value in notes.items() if key.startswith(_PREFIX)}
    return dict(sorted(found.items(), key=lambda item: -item[1]))
