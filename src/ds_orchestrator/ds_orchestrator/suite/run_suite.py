"""Drives a suite's tests with a driver, and compares with the outcomes in the suite."""

from __future__ import annotations

from pathlib import Path

from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.comparison.analysis import Comparison, compare_networks
from ds_orchestrator.comparison.drives import ComparedTest, DriveOutcome, Network, PairedDrive
from ds_orchestrator.comparison.given_tests import Engine, drive_tests
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.suite.suite_file import Suite, SuiteOutcome
from ds_sim.conditions.text import parse_conditions
from ds_sim.gates.gate import Gate, GateState
from ds_sim.simulator import Outcome


def config_of_suite(suite: Suite, driver: str) -> CampaignConfig:
    """A configuration under which a suite's tests are driven.

    Raises:
        ds_orchestrator.campaign.config.ConfigError: the suite's simulators do not make a campaign.
    """
    raw = {
        "siblings": suite.siblings, "twin": suite.twin, "driver": driver, "lane": suite.lane,
        "maxitwo_compatible": suite.maxitwo_compatible,
        "search": {"method": "random", "population": len(suite.tests), "iterations": 0, "runs": 1},
        # Only a store with gates keeps conditions; the tests are known to be valid, so that no gate is driven.
        "gates": "all" if any(test.conditions for test in suite.tests) else "conditions",
    }  # fmt: skip
    return parse_config(raw, "the suite")


def run_suite(
    suite: Suite, config: CampaignConfig, candidate: Network, folder: Path, engine: Engine, *, source: str
) -> tuple[Comparison, dict[tuple[str, str], Execution]]:
    """Drive a suite, and compare its outcomes with those of the suite.

    Args:
        suite: the suite.
        config: of `config_of_suite`, with the engine.
        candidate: the driver.
        folder: for the drives; a run that was stopped goes on there.
        engine: what drives.
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
            conditions=parse_conditions(suite_test.conditions),
        )
        for number, suite_test in enumerate(suite.tests)
    }
    work = {name: [tests[one.name] for one in suite.tests if name in one.outcomes] for name in suite.simulators}
    valid = Gate(state=GateState.VALID, outcome=Outcome.COMPLETED)
    gates = {(test.test_id, name): valid for name, of in work.items() for test in of}
    found = drive_tests(config, {name: of for name, of in work.items() if of}, folder, engine, gates=gates)
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
