# SPDX-License-Identifier: Apache-2.0
"""Estimate of the time that a campaign still takes."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence

from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName

REMEMBERED = 30
"""Executions on each simulator whose durations count; chosen: enough to average roads, few enough to follow a machine
that becomes busy."""
WELL_UNDER_WAY = 0.1
"""Part of a road from which a drive says how long it takes; chosen: beyond the start, in which the car accelerates."""


class Eta:
    """Estimates how long a campaign still drives, from its latest executions and from those under way.

    The simulators of a stage work in parallel, the stages one after the other. Times are seconds of a steady clock.
    """

    def __init__(self) -> None:
        self._expected: Sequence[Mapping[SimulatorName, int]] = []
        self._done: dict[tuple[int, str], int] = {}
        self._last: dict[SimulatorName, float] = {}
        self._took: dict[SimulatorName, deque[float]] = {}

    def expect(self, stages: Sequence[Mapping[SimulatorName, int]]) -> None:
        """Set how many executions each stage has on each simulator, finished ones included."""
        self._expected = stages

    def begin(self, now: float) -> None:
        """Begin a stage."""
        self._last = dict.fromkeys((name for stage in self._expected for name in stage), now)

    def finished(self, stage: int, simulator: SimulatorName, now: float, *, fresh: bool) -> None:
        """Count a finished execution; one of an earlier session (not fresh) took no time."""
        self._done[stage, simulator] = self._done.get((stage, simulator), 0) + 1
        if fresh:
            took = now - self._last.get(simulator, now)
            self._took.setdefault(simulator, deque(maxlen=REMEMBERED)).append(took)
        self._last[simulator] = now
        if stage < len(self._expected) and not self._rest(stage):
            self.begin(now)

    def _rest(self, stage: int) -> dict[SimulatorName, int]:
        """Executions of a stage that are left, by simulator."""
        rest = {name: count - self._done.get((stage, name), 0) for name, count in self._expected[stage].items()}
        return {name: count for name, count in rest.items() if count > 0}

    def seconds(self, now: float, drives: Sequence[tuple[SimulatorName, float, float | None]] = ()) -> float | None:
        """Estimate the seconds left; None until an execution has finished in this session, or is well under way.

        Of drives under way: simulator, seconds so far, and driven part of the road, in [0, 1], or None.
        """
        took = {name: list(seconds) for name, seconds in self._took.items()}
        at_once = Counter(name for name, _, _ in drives)
        for name, seconds, part in drives:
            if part is not None and part >= WELL_UNDER_WAY and len(took.get(name, ())) < at_once[name]:
                took.setdefault(name, []).append(seconds / part / at_once[name])
        if not took:
            return None
        means = {name: sum(seconds) / len(seconds) for name, seconds in took.items()}
        # A simulator that has not driven yet is taken to be as fast as the others.
        usual, left, is_present = sum(means.values()) / len(means), 0.0, True
        for stage in range(len(self._expected)):
            of_each, rest = [0.0], self._rest(stage)
            for name, count in rest.items():
                waited = now - self._last.get(name, now) if is_present else 0.0
                mean = max(means.get(name, usual), waited)  # what is under way takes at least as long as it did so far
                of_each.append(count * mean - waited)
            left += max(of_each)
            is_present = is_present and not rest
        return left


class TimedListener(Listener):
    """Counts executions and estimates the time left; base of what shows how far a campaign is.

    Attributes:
        done: executions that are finished, those of earlier sessions included.
        total: executions that are expected at the end, or 0 if that is not known yet.
    """

    def __init__(self) -> None:
        self._lock, self._eta = threading.RLock(), Eta()
        self.done = self.total = 0

    def stage(self, name: str) -> None:
        """See `Listener.stage`."""
        with self._lock:
            self._eta.begin(time.monotonic())

    def expect(self, stages: Sequence[Mapping[SimulatorName, int]]) -> None:
        """See `Listener.expect`."""
        with self._lock:
            self._eta.expect(stages)
            self.total = sum(sum(stage.values()) for stage in stages)

    def finished(self, test: Test, simulator: SimulatorName, execution: Execution | Gate | None, fresh: bool) -> None:
        """See `Listener.finished`."""
        with self._lock:
            self.done += 1
            # A test is driven on its own sibling by the search, elsewhere by the stage after that.
            self._eta.finished(int(test.sibling != simulator), simulator, time.monotonic(), fresh=fresh)

    def seconds_left(self, drives: Sequence[tuple[SimulatorName, float, float | None]] = ()) -> float | None:
        """Estimate the time left, s; see `Eta.seconds`."""
        with self._lock:
            return self._eta.seconds(time.monotonic(), drives)
