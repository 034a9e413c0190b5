"""Chooses the frames of which a report has camera pictures: strips of informative drives, replays of failed ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Execution, Test
from ds_sim.simulator import FRAME_RATE

DRIVEN_TESTS = 24
"""Largest number of tests of which every drive has a strip of pictures; chosen: 1.5 MB, rendered in 8 s of processor
time."""
MOMENTS = 5
"""Pictures of a strip; chosen: a row of them fits on a screen."""
BEFORE_FAILURE = 1.0
"""Time between pictures of a failed drive's strip, the last of which shows the failure, s; chosen: shows the car
leaving the lane, and the bend in which it does."""
REPLAY_PICTURES = 3000
"""Largest number of pictures of all replays; chosen: 14 MB in the file at 4.8 kB each in base64, so that a report with
5,000 tests has about 31 MB."""
SPACINGS = (10, 20, 40)
"""Frames between two pictures of a replay, the first with which all failed drives fit; chosen: 0.5 s, in which the car
moves by its own length, to 2 s, which still shows every bend."""

Drive = tuple[str, str]
"""A test's id and a simulator."""


@dataclass(frozen=True, kw_only=True)
class PicturePlan:
    """Frames of which a report has pictures.

    Attributes:
        frames: test and simulator -> frames to render, increasing.
        strips: number of tests of which every drive has a strip.
        spacing: time between two pictures of a replay, s.
        replayed: number of failed drives whose replay has pictures.
        failed: number of failed drives.
    """

    frames: Mapping[Drive, Sequence[int]]
    strips: int = 0
    spacing: float = SPACINGS[0] / FRAME_RATE
    replayed: int = 0
    failed: int = 0


def plan_pictures(
    tests: Sequence[Test],
    executions: Sequence[Execution],
    cells: Mapping[str, Cell],
    *,
    strips: int = DRIVEN_TESTS,
    replays: int = REPLAY_PICTURES,
) -> PicturePlan:
    """Choose the frames to render; the same campaign gives the same plan.

    Failed drives come first, those of the worst test before all others, at the finest of `SPACINGS` with which all of
    them fit; if none does, at the coarsest, and the last ones have no replay with pictures. The other drives of the
    same tests follow as long as there is room.

    Args:
        tests: every test, in the campaign's order.
        executions: every execution.
        cells: test -> cell; tests without one have no pictures.
        strips: largest number of tests with strips.
        replays: largest number of pictures in all replays.
    """
    driven = {e.test_id for e in executions}
    known = [test for test in tests if test.test_id in driven and test.test_id in cells]
    ranked = worst_first(known, executions)
    of_test: dict[str, list[Execution]] = {}
    for execution in executions:
        if len(execution.trajectory):
            of_test.setdefault(execution.test_id, []).append(execution)
    in_order = [e for test_id in ranked for e in of_test.get(test_id, [])]
    failed = [e for e in in_order if e.outcome.is_failure]
    tests_that_fail = {e.test_id for e in failed}
    others = [e for e in in_order if e.test_id in tests_that_fail and not e.outcome.is_failure]

    totals = {spacing: sum(len(replay_frames(e, spacing)) for e in failed) for spacing in SPACINGS}
    spacing = next((s for s in SPACINGS if totals[s] <= replays), SPACINGS[-1])
    frames: dict[Drive, list[int]] = {}
    left = replays
    for execution in (*failed, *others):
        chosen = replay_frames(execution, spacing)
        if len(chosen) > left:
            break
        left -= len(chosen)
        frames[execution.test_id, execution.simulator] = chosen
    replayed = sum((e.test_id, e.simulator) in frames for e in failed)

    told = telling_tests(known, executions, cells, most=strips)
    for test in told:
        for execution in of_test.get(test.test_id, []):
            frames.setdefault((execution.test_id, execution.simulator), [])
    for execution in in_order:
        drive = execution.test_id, execution.simulator
        if drive in frames:
            frames[drive] = sorted({*frames[drive], *moments(execution)})
    return PicturePlan(
        frames=frames, strips=len(told), spacing=spacing / FRAME_RATE, replayed=replayed, failed=len(failed)
    )


def worst_first(tests: Iterable[Test], executions: Sequence[Execution]) -> list[str]:
    """Sort tests: those that fail on more simulators first, then those that come closer to the lane's edge on any."""
    failures: dict[str, int] = {}
    nearest: dict[str, float] = {}
    for execution in executions:
        failures[execution.test_id] = failures.get(execution.test_id, 0) + execution.outcome.is_failure
        nearest[execution.test_id] = min(nearest.get(execution.test_id, np.inf), execution.fitness)
    ids = (test.test_id for test in tests)
    return sorted(ids, key=lambda test_id: (-failures[test_id], nearest[test_id], test_id))


def telling_tests(
    tests: Sequence[Test], executions: Sequence[Execution], cells: Mapping[str, Cell], *, most: int = DRIVEN_TESTS
) -> list[Test]:
    """Select the most informative tests, in the campaign's order: the worst of every cell, then others that failed."""
    driven = {e.test_id for e in executions}
    ranked = worst_first((t for t in tests if t.test_id in driven and t.test_id in cells), executions)
    worst: dict[Cell, str] = {}
    for test_id in ranked:
        worst.setdefault(cells[test_id], test_id)
    failing = {e.test_id for e in executions if e.outcome.is_failure}
    chosen = set(list(dict.fromkeys([*worst.values(), *(i for i in ranked if i in failing)]))[:most])
    return [test for test in tests if test.test_id in chosen]


def moments(execution: Execution) -> list[int]:
    """Select the frames of a strip, increasing: a failed drive's last seconds, else evenly spread ones."""
    last = len(execution.trajectory) - 1
    if last < 0:
        return []
    first = max(0, last - round(BEFORE_FAILURE * FRAME_RATE) * (MOMENTS - 1)) if execution.outcome.is_failure else 0
    return [int(k) for k in np.unique(np.linspace(first, last, MOMENTS).round().astype(int))]


def replay_frames(execution: Execution, spacing: int) -> list[int]:
    """Select the frames of a replay, increasing: the last one, every `spacing`-th before it, and the first one."""
    return sorted({0, *range(len(execution.trajectory) - 1, -1, -spacing)})
