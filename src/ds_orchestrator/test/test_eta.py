# SPDX-License-Identifier: Apache-2.0
"""Estimates of the time left, for a campaign on a simulated clock: parallel simulators, consecutive stages."""

from __future__ import annotations

import heapq

import pytest

from ds_orchestrator.campaign.eta import Eta
from ds_sim import SimulatorName

FAST, LONG, SLOW, TWIN = map(SimulatorName, ("fast", "long", "slow", "twin"))

A, QUICK = map(SimulatorName, ("a", "quick"))

TOOK = {FAST: 2.0, SLOW: 5.0, TWIN: 3.0}
STAGES = [{FAST: 40, SLOW: 40}, {FAST: 40, SLOW: 40, TWIN: 80}]
WHOLE = 40 * 5.0 + 80 * 3.0


def estimates(known: int = 0) -> list[tuple[float, float]]:
    """Pair the true seconds left at the end of each execution with the estimate, in order.

    Args:
        known: executions of the first stage on each simulator that a previous session finished.
    """
    left, now, said = Eta(), 0.0, []
    left.expect(STAGES)
    for number, stage in enumerate(STAGES):
        left.begin(now)
        ends = []
        for name, count in stage.items():
            before = known if number == 0 else 0
            for _ in range(before):
                left.finished(number, SimulatorName(name), now, fresh=False)
            ends += [(now + TOOK[name] * (k + 1), name) for k in range(count - before)]
        heapq.heapify(ends)
        while ends:
            now, name = heapq.heappop(ends)
            left.finished(number, SimulatorName(name), now, fresh=True)
            said.append((now, left.seconds(now) or 0.0))
    return [(now - moment, seconds) for moment, seconds in said]


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
    left = Eta()
    left.expect([{A: 200}])
    left.begin(0.0)
    left.finished(0, A, 0.0, fresh=False)
    assert left.seconds(0.0) is None
    now = 0.0
    for took in [1.0] * 50 + [4.0] * 50:
        now += took
        left.finished(0, A, now, fresh=True)
    assert left.seconds(now) == pytest.approx(99 * 4.0)


def test_a_first_long_drive_counts_while_it_is_under_way() -> None:
    """One simulator excludes a test at once; the other's first drive has taken 40 s and is at half of its road."""
    left = Eta()
    left.expect([{QUICK: 5, LONG: 5}, {TWIN: 10}])
    left.begin(0.0)
    assert left.seconds(8.0, [(LONG, 8.0, 0.05)]) is None  # the car still accelerates
    assert left.seconds(40.0, [(LONG, 40.0, 0.5)]) == pytest.approx(5 * 80.0 - 40.0 + 10 * 80.0)
    left.finished(0, QUICK, 0.0, fresh=True)
    # What is under way without feedback takes at least as long as it did so far.
    assert (left.seconds(40.0, [(LONG, 40.0, None)]) or 0.0) >= 4 * 40.0
    said = left.seconds(40.0, [(LONG, 40.0, 0.5)])
    assert said == pytest.approx(5 * 80.0 - 40.0 + 10 * (0.0 + 80.0) / 2)
