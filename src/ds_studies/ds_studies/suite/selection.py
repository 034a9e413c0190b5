"""Chooses the tests of a campaign that tell most: failing ones, boundary ones, and one of every cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ds_orchestrator.campaign.folder import DRIVER_SHA256, CampaignData
from ds_orchestrator.engines.fingerprint import code_sha256
from ds_orchestrator.store.model import Execution, Test
from ds_studies.suite.suite_file import MOST_TESTS, Reason, Suite, SuiteError, SuiteOutcome, SuiteTest, road_sha256

TESTS = 30
"""Tests of a suite; chosen: 90 drives on three simulators, five minutes at the 18 drives a minute of two cores."""


def select(data: CampaignData, *, most: int) -> dict[str, list[Reason]]:
    """Choose tests, in turns from three lists until there are enough; why each was chosen.

    - `failing`: fails on most simulators first, then the largest distance out of the lane.
    - `boundary`: smallest absolute margin to the lane's edge on any simulator, on either side of it.
    - `cell`: of every cell the test with the smallest margin; cells with the smallest one first.

    Only tests with a verdict on every simulator take part.

    Args:
        data: contents of the campaign.
        most: largest number of tests.
    """
    done = {(one.test_id, one.simulator): one for one in data.verdicts}
    names = data.config.simulators
    margins: dict[str, list[float]] = {}
    failures: dict[str, int] = {}
    for test in data.tests:
        runs = [done.get((test.test_id, name)) for name in names]
        known = [run for run in runs if run is not None]
        if len(known) == len(names):
            margins[test.test_id] = [run.fitness for run in known]
            failures[test.test_id] = sum(run.outcome.is_failure for run in known)
    failing = sorted((i for i in margins if failures[i]), key=lambda i: (-failures[i], min(margins[i]), i))
    boundary = sorted(margins, key=lambda i: (min(map(abs, margins[i])), i))
    worst_first = sorted(margins, key=lambda i: (min(margins[i]), i))
    of_cell: dict[object, str] = {}
    for test_id in worst_first:
        if test_id in data.cells:
            of_cell.setdefault(data.cells[test_id], test_id)
    lists: dict[Reason, list[str]] = {"failing": failing, "boundary": boundary, "cell": list(of_cell.values())}
    return _in_turns(lists, most)


def _in_turns(lists: Mapping[Reason, Sequence[str]], most: int) -> dict[str, list[Reason]]:
    """Take from each list in turn the next test that is not chosen yet; a test that fails or is its cell's says so."""
    chosen: dict[str, list[Reason]] = {}
    rest = {reason: iter(tests) for reason, tests in lists.items()}
    while rest and len(chosen) < most:
        for reason in list(rest):
            test_id = next((i for i in rest[reason] if i not in chosen), None)
            if test_id is None:
                del rest[reason]
            elif len(chosen) < most:
                chosen[test_id] = [
                    name for name in lists if name == reason or (name != "boundary" and test_id in lists[name])
                ]
    return chosen


def suite_of(folder: Path, data: CampaignData, *, most: int = TESTS) -> Suite:
    """Make a suite of a campaign's tests that tell most.

    Args:
        folder: campaign folder.
        data: its contents.
        most: largest number of tests.

    Raises:
        SuiteError: no test has a verdict on every simulator.
    """
    chosen = select(data, most=min(most, MOST_TESTS))
    if not chosen:
        raise SuiteError(
            f"{folder} has no test with a verdict on every simulator: run `ds campaign resume {folder}` first"
        )
    config = data.config
    done = {(one.test_id, one.simulator): one for one in data.verdicts}
    by_id = {test.test_id: test for test in data.tests}
    return Suite(
        campaign=folder.resolve().name,
        driver=config.driver,
        driver_sha256=data.notes.get(DRIVER_SHA256, ""),
        siblings=list(config.siblings),
        twin=config.twin,
        lane=config.lane,
        maxitwo_compatible=config.maxitwo_compatible,
        features=list(config.features),
        code_sha256=code_sha256(),
        tests=[
            _test(
                by_id[test_id], why, data.cells.get(test_id), {name: done[test_id, name] for name in config.simulators}
            )
            for test_id, why in chosen.items()
        ],
    )


def _test(
    test: Test, why: list[Reason], cell: tuple[int, ...] | None, executions: Mapping[str, Execution]
) -> SuiteTest:
    points = [[float(value) for value in point] for point in test.road.control_points]
    return SuiteTest(
        name=test.test_id,
        why=why,
        control_points=points,
        road_sha256=road_sha256(points),
        seed=test.seed,
        conditions=test.conditions,
        cell=None if cell is None else list(cell),
        outcomes={
            name: SuiteOutcome.model_validate(
                {"outcome": one.outcome.name, "fitness": one.fitness, "trajectory_sha256": one.trajectory_sha256}
            )
            for name, one in executions.items()
        },
    )
