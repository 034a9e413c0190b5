"""Drives a suite's tests with a driver, and compares with the outcomes in the suite."""

from __future__ import annotations

from pathlib import Path

from ds_analysis.comparison.analysis import Comparison, compare_networks
from ds_analysis.comparison.drives import ComparedTest, DriveOutcome, Network, PairedDrive
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Progress, drive_tests
from ds_orchestrator.store.model import Execution, Test
from ds_sim.simulator import Outcome
from ds_studies.suite.suite_file import Suite, SuiteOutcome


def settings_of_suite(suite: Suite, driver: str) -> DriveSettings:
    """How a suite's tests are driven: without gates, as the suite's tests are known to be valid."""
    return DriveSettings(siblings=tuple(suite.siblings), twin=suite.twin, driver=driver, gates="none")


def run_suite(
    suite: Suite, settings: DriveSettings, candidate: Network, folder: Path, progress: Progress, *, source: str
) -> tuple[Comparison, dict[tuple[str, str], Execution]]:
    """Drive a suite, and compare its outcomes with those of the suite.

    Args:
        suite: the suite.
        settings: of `settings_of_suite`, with the engine.
        candidate: the driver.
        folder: for the drives; a run that was stopped goes on there.
        progress: who hears of it.
        source: where the tests come from, in words.

    Returns:
        The comparison, and every execution by test and simulator.
    """
    tests = {
        suite_test.name: Test(
            test_id=f"suite-0-{number:04d}",
            sibling=suite.siblings[0],
            run=0,
            number=number,
            road=suite.road_of(suite_test),
            seed=suite_test.seed,
            conditions=suite_test.conditions,
        )
        for number, suite_test in enumerate(suite.tests)
    }
    work = {name: [tests[one.name] for one in suite.tests if name in one.outcomes] for name in suite.simulators}
    found = drive_tests(settings, {name: of for name, of in work.items() if of}, folder, progress)
    pairs, left_out, executions = [], [], {}
    for one in suite.tests:
        test = tests[one.name]
        compared = ComparedTest(
            name=one.name,
            road=test.road,
            seed=test.seed,
            conditions=test.conditions,
            cell=None if one.cell is None else tuple(one.cell),
        )
        for name, expected in one.outcomes.items():
            key = (test.test_id, name)
            if key in found.executions:
                execution = executions[one.name, name] = found.executions[key]
                pairs.append(
                    PairedDrive(
                        test=compared,
                        simulator=name,
                        reference=_outcome(expected),
                        candidate=DriveOutcome.of(execution),
                    )
                )
            elif key in found.errors:
                left_out.append((one.name, name, found.errors[key]))
    comparison = compare_networks(
        pairs,
        reference=Network(driver=suite.driver, sha256=suite.driver_sha256),
        candidate=candidate,
        origin="suite",
        source=source,
        simulators=suite.simulators,
        features=suite.features,
        twin=suite.twin,
        excluded=len(found.excluded),
        left_out=left_out,
    )
    return comparison, executions


def with_outcomes(suite: Suite, candidate: Network, executions: dict[tuple[str, str], Execution], code: str) -> Suite:
    """The same tests with the outcomes of another network, to be expected from now on."""
    return suite.model_copy(
        update={
            "driver": candidate.driver,
            "driver_sha256": candidate.sha256,
            "code_sha256": code,
            "tests": [
                test.model_copy(
                    update={
                        "outcomes": {
                            name: _expected(executions[test.name, name]) if (test.name, name) in executions else known
                            for name, known in test.outcomes.items()
                        }
                    }
                )
                for test in suite.tests
            ],
        }
    )


def _outcome(expected: SuiteOutcome) -> DriveOutcome:
    return DriveOutcome(
        outcome=Outcome[expected.outcome], fitness=expected.fitness, trajectory_sha256=expected.trajectory_sha256
    )


def _expected(execution: Execution) -> SuiteOutcome:
    return SuiteOutcome.model_validate(
        {
            "outcome": execution.outcome.name,
            "fitness": execution.fitness,
            "trajectory_sha256": execution.trajectory_sha256,
        }
    )
