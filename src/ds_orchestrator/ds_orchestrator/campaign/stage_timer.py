"""Wall-clock time of a campaign's stages over all sessions; reported only, no result depends on it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.gates.gate import Gate

_PREFIX = "seconds "


class StageTimer:
    """Listener that adds up the duration of each stage in the store and forwards every call.

    Args:
        listener: receives every call.
        store: store of the campaign, in which the seconds are kept.
        clock: monotonic clock, s.
    """

    def __init__(self, listener: Listener, store: Store, clock: Callable[[], float] = time.monotonic) -> None:
        self._listener = listener
        self._store = store
        self._clock = clock
        self._name = ""
        self._began = 0.0

    def stage(self, name: str) -> None:
        """See `Listener.stage`."""
        self.end()
        self._name, self._began = name, self._clock()
        self._listener.stage(name)

    def end(self) -> None:
        """End the current stage, if there is one."""
        if self._name:
            self._store.add_seconds(self._name, self._clock() - self._began)
        self._name = ""

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        """See `Listener.expect`."""
        self._listener.expect(stages)

    def finished(self, test: Test, simulator: str, execution: Execution | Gate | None, fresh: bool) -> None:
        """See `Listener.finished`."""
        self._listener.finished(test, simulator, execution, fresh)


def seconds_of(notes: Mapping[str, str]) -> dict[str, float]:
    """Read stage -> seconds from a store's notes; longest first."""
    found = {key.removeprefix(_PREFIX): float(value) for key, value in notes.items() if key.startswith(_PREFIX)}
    return dict(sorted(found.items(), key=lambda item: -item[1]))
