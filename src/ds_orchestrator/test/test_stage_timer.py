"""Time per stage over several sessions, on a clock that the test sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ds_orchestrator.campaign.stage_timer import StageTimer, seconds_of
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.store import Store
from ds_sim.gates.gate import Gate


class Silent:
    """Listener that records the calls."""

    def __init__(self) -> None:
        self.told: list[object] = []

    def stage(self, name: str) -> None:
        self.told.append(name)

    def expect(self, stages: Sequence[Mapping[str, int]]) -> None:
        self.told.append(stages)

    def finished(self, test: Test, simulator: str, execution: Execution | Gate | None, fresh: bool) -> None:
        self.told.append(simulator)


def test_stages_add_up_over_sessions(tmp_path: Path) -> None:
    store, listener = Store(tmp_path / "campaign.sqlite", config="{}"), Silent()
    times = iter([10.0, 12.5, 12.5, 20.0])
    first = StageTimer(listener, store, lambda: next(times))
    first.end()  # no stage has started
    first.expect([{"a": 7}])
    first.stage("search")
    first.stage("twin")
    first.end()
    first.end()
    again = iter([100.0, 101.0])
    second = StageTimer(listener, store, lambda: next(again))
    second.stage("search")
    second.end()
    assert listener.told == [[{"a": 7}], "search", "twin", "search"]
    store.note("another fact", "3")
    assert seconds_of(store.notes()) == {"twin": 7.5, "search": 3.5}
