# SPDX-License-Identifier: Apache-2.0
"""Listener that counts a campaign's executions, and estimates how long it still drives."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence

from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.store.model import Execution, Test
from ds_sim.gates.gate import Gate
from ds_sim.registry import SimulatorName

REMEMBERED = 30
"""Executions on each simulator whose durations count; chosen: enough to average roads, few enough to follow a machine
that becomes busy."""
WELL_UNDER_WAY = 0.1
"""Part of a road from which a drive says how long it takes; chosen: beyond the start, in which the car accelerates."""


class TimedListener(Listener):
    """Counts executions, and estimates how long a campaign still drives, from its latest ones and those under way.

    The simulators of a stage work in parallel, the stages one after the other. `done` executions are finished, those of
    earlier sessions included, of a `total` that are expected at the end, or 0 if that is not known yet.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._lock = now, threading.RLock()
        self._expected: Sequence[Mapping[SimulatorName, int]] = []
        self._done: Counter[tuple[int, SimulatorName]] = Counter()
        self._last: dict[SimulatorName, float] = {}
        self._took: dict[SimulatorName, deque[float]] = {}
        self.done = self.total = 0

    def stage(self, name: str) -> None:
        """See `Listener.stage`."""
        with self._lock:
            self._begin()

    def expect(self, stages: Sequence[Mapping[SimulatorName, int]]) -> None:
        """See `Listener.expect`."""
        with self._lock:
            self._expected, self.total = stages, sum(sum(stage.values()) for stage in stages)

    def finished(self, test: Test, simulator: SimulatorName, execution: Execution | Gate | None, fresh: bool) -> None:
        """See `Listener.finished`; an execution of an earlier session (not fresh) took no time."""
        stage = int(test.sibling != simulator)  # the search drives a test on its own sibling, the next stage elsewhere
        with self._lock:
            now = self._now()
            self.done += 1
            self._done[stage, simulator] += 1
            if fresh:
                took = now - self._last.get(simulator, now)
                self._took.setdefault(simulator, deque(maxlen=REMEMBERED)).append(took)
            self._last[simulator] = now
            if stage < len(self._expected) and not self._rest(stage):
                self._begin()

    def driven(self) -> None:
        """Estimate nothing any more, as only results are computed."""
        with self._lock:
            self._took.clear()

    def _begin(self) -> None:
        self._last = dict.fromkeys((name for stage in self._expected for name in stage), self._now())

    def _rest(self, stage: int) -> dict[SimulatorName, int]:
        """Executions of a stage that are left, by simulator."""
        rest = {name: count - self._done[stage, name] for name, count in self._expected[stage].items()}
        return {name: count for name, count in rest.items() if count > 0}

    def seconds_left(self, drives: Sequence[tuple[SimulatorName, float, float | None]] = ()) -> float | None:
        """Estimate the seconds left; None until an execution has finished in this session, or is well under way.

        Of drives under way: simulator, seconds so far, and driven part of the road, in [0, 1], or None.
        """
        with self._lock:
            now = self._now()
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
                    mean = max(means.get(name, usual), waited)  # at least as long as what is under way did so far
                    of_each.append(count * mean - waited)
                left += max(of_each)
                is_present = is_present and not rest
            return left
