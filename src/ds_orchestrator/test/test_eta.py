# SPDX-License-Identifier: Apache-2.0
"""Estimates of the time left, for a campaign on a simulated clock: parallel simulators, consecutive stages."""

from __future__ import annotations

import heapq

import pytest

from ds_orchestrator.campaign.live_file import TimedListener
from ds_orchestrator.store.model import Origin, Test
from ds_road import Road
from ds_sim import SimulatorName
from ds_sim.scenario import Scenario

A, FAST, LONG, QUICK, SLOW, TWIN = map(SimulatorName, ("a", "fast", "long", "quick", "slow", "twin"))

TOOK = {FAST: 2.0, SLOW: 5.0, TWIN: 3.0}
STAGES = [{FAST: 40, SLOW: 40}, {FAST: 40, SLOW: 40, TWIN: 80}]
WHOLE = 40 * 5.0 + 80 * 3.0


SCENARIO = Scenario(Road([[0, 0], [0, 25], [0, 50], [0, 75]]), seed=1)


class Left(TimedListener):
    """Estimate with a clock that a test sets."""

    def __init__(self, *stages: dict[SimulatorName, int]) -> None:
        super().__init__(lambda: self.clock)
        self.clock = 0.0
        self.expect(stages)
        self.stage("first")

    def end(self, stage: int, simulator: SimulatorName, *, fresh: bool = True) -> None:
        origin = Origin(SimulatorName("another") if stage else simulator, 0, 0)
        self.finished(Test("t", SCENARIO, origin), simulator, None, fresh)

    def at(self, clock: float, *drives: tuple[SimulatorName, float, float | None]) -> float | None:
        self.clock = clock
        return self.seconds_left(drives)


def estimates(known: int) -> list[tuple[float, float]]:
    """Pair the true seconds left at the end of each execution with the estimate, in order.

    A previous session has finished the first `known` executions of the first stage on each simulator.
    """
    left, said = Left(*STAGES), []
    for number, stage in enumerate(STAGES):
        now = left.clock
        left.stage("next")
        ends = []
        for name, count in stage.items():
            before = known if number == 0 else 0
            for _ in range(before):
                left.end(number, name, fresh=False)
            ends += [(now + TOOK[name] * (k + 1), name) for k in range(count - before)]
        heapq.heapify(ends)
        while ends:
            left.clock, name = heapq.heappop(ends)
            left.end(number, name)
            said.append((left.clock, left.seconds_left() or 0.0))
    return [(left.clock - moment, seconds) for moment, seconds in said]


@pytest.mark.parametrize("known", [0, 30])
def test_it_is_right_in_every_stage_and_after_a_resume(known: int) -> None:
    found = estimates(known)
    assert found[0][0] == pytest.approx(WHOLE - known * 5.0 - 2.0)
    for true, said in found[4:]:
        # The twin is assumed to be as fast as the others until it has driven; nothing is assumed afterwards.
        assert said == pytest.approx(true, abs=0.2 * true + 5.0)
    afterwards = [pair for pair in found if pair[0] < 80 * 3.0 - 6.0]
    assert len(afterwards) > 100
    for true, said in afterwards:
        assert said == pytest.approx(true, abs=5.0)


def test_it_follows_a_machine_that_becomes_slower_and_says_nothing_at_first() -> None:
    left = Left({A: 200})
    left.end(0, A, fresh=False)
    assert left.at(0.0) is None
    for took in [1.0] * 50 + [4.0] * 50:
        left.clock += took
        left.end(0, A)
    assert left.seconds_left() == pytest.approx(99 * 4.0)
    left.driven()
    assert left.seconds_left() is None and (left.done, left.total) == (101, 200)


def test_a_first_long_drive_counts_while_it_is_under_way() -> None:
    """One simulator excludes a test at once; the other's first drive has taken 40 s and is at half of its road."""
    left = Left({QUICK: 5, LONG: 5}, {TWIN: 10})
    assert left.at(8.0, (LONG, 8.0, 0.05)) is None  # the car still accelerates
    assert left.at(40.0, (LONG, 40.0, 0.5)) == pytest.approx(5 * 80.0 - 40.0 + 10 * 80.0)
    left.clock = 0.0
    left.end(0, QUICK)
    # What is under way without feedback takes at least as long as it did so far.
    assert (left.at(40.0, (LONG, 40.0, None)) or 0.0) >= 4 * 40.0
    assert left.at(40.0, (LONG, 40.0, 0.5)) == pytest.approx(5 * 80.0 - 40.0 + 10 * (0.0 + 80.0) / 2)
