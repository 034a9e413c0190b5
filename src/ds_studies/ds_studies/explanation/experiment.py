# SPDX-License-Identifier: Apache-2.0
"""Drives failed tests again with the parts of two simulators exchanged, each alone and all combinations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ds_analysis.failures.reasons import Groups
from ds_base.errors import RunError
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.engines.drive_tests import Callbacks, DriveResults, drive_tests
from ds_orchestrator.store.model import Test
from ds_sim.conditions.model import DEFAULT
from ds_sim.hybrid import PARTS, differing_parts, exchangeable, hybrid_name
from ds_sim.registry import SimulatorName
from ds_studies.explanation.shares import CONDITIONS, Explanation, Subset, loss_of, subsets

_PLAIN = "plain-"
"""Begins the id of a test whose conditions were removed."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One failed test, and the simulator that completes it.

    Attributes:
        parts: word for what is exchanged -> the parts of simulators in it; none for the test's conditions.
    """

    test: Test
    fails: SimulatorName
    against: SimulatorName
    parts: dict[str, tuple[str, ...]]

    def drive(self, of_failing: Subset) -> tuple[SimulatorName, Test]:
        """Simulator and test of the drive that has some parts of the failing simulator, all others of the other."""
        taken = {part for word in of_failing for part in self.parts[word]}
        name = hybrid_name({part: self.fails if part in taken else self.against for part in PARTS})
        if CONDITIONS in self.parts and CONDITIONS not in of_failing:
            plain = replace(self.test.scenario, conditions=DEFAULT)
            return name, replace(self.test, test_id=_PLAIN + self.test.test_id, scenario=plain)
        return name, self.test

    def explained(self, results: DriveResults) -> Explanation:
        """Share out the difference."""
        losses = {}
        for subset in subsets(tuple(self.parts)):
            name, test = self.drive(subset)
            execution = results.executions.get((test.test_id, name))
            if execution is None:
                raise ExplanationError(f"{test.test_id} on {name}: {results.errors[test.test_id, name]}")
            losses[subset] = loss_of(execution, test.road.lane_width / 2)
        return Explanation(test_id=self.test.test_id, fails=self.fails, against=self.against, losses=losses)


class ExplanationError(RunError):
    """A drive of an experiment gave no outcome."""


def experiment_on(
    data: CampaignData, test_id: str, fails: SimulatorName | None = None, against: SimulatorName | None = None
) -> Experiment:
    """Plan the exchanges for one test of a campaign.

    Args:
        data: contents of its store.
        test_id: the test.
        fails: simulator on which it fails; the first such one if None.
        against: simulator on which it completes; the one that keeps closest to the lane's middle if None.

    Raises:
        ConfigError: there is no such test, or it does not fail there, or no other simulator completes it.
        ValueError: the parts of a simulator cannot be exchanged.
    """
    tests = {test.test_id: test for test in data.tests}
    if test_id not in tests:
        examples = ", ".join(list(tests)[:2]) or "(it has no tests yet)"
        raise ConfigError(f"the campaign has no test {test_id!r:.60}: expected an id such as {examples}")
    done = {e.simulator: e for e in data.verdicts if e.test_id == test_id}
    failing = [name for name in data.config.simulators if name in done and done[name].outcome.is_failure]
    completing = [name for name in data.config.simulators if name in done and name not in failing]
    for name, among, what in ((fails, failing, "fails"), (against, completing, "completes")):
        if not among or (name is not None and name not in among):
            where = f"on {name}" if name is not None else "on any simulator"
            hint = f": expected {' or '.join(among)}" if among else ", so there is nothing to exchange"
            raise ConfigError(f"{test_id} never {what} {where}{hint}")
    fails = fails or failing[0]
    against = against or min(completing, key=lambda name: done[name].max_lateral_position)
    differing = differing_parts(exchangeable(against), exchangeable(fails))
    parts = {" and ".join(together): together for together in differing}
    if not tests[test_id].conditions.is_default:
        parts[CONDITIONS] = ()
    return Experiment(test=tests[test_id], fails=fails, against=against, parts=parts)


def experiments_on(data: CampaignData, groups: Groups, most: int) -> list[Experiment]:
    """Plan an experiment for each of the largest groups, at most `most`, that has a test which another completes."""
    passed = {execution.test_id for execution in data.verdicts if not execution.outcome.is_failure}
    firsts = [next((one for one in of if one.test_id in passed), None) for of in groups.values()]
    return [experiment_on(data, one.test_id, one.simulator) for one in filter(None, firsts)][:most]


def drive_experiments(
    experiments: Sequence[Experiment], settings: DriveSettings, folder: Path, callbacks: Callbacks
) -> DriveResults:
    """Drive experiments, which may have drives in common; errors are those of `drive_tests`.

    The settings' simulators are replaced by those of the experiments; nothing is gated or recorded.
    """
    if not experiments:
        return DriveResults()
    work: dict[SimulatorName, list[Test]] = {}
    for experiment in experiments:
        for subset in subsets(tuple(experiment.parts)):
            name, test = experiment.drive(subset)
            if test not in work.setdefault(name, []):
                work[name].append(test)
    settings = replace(settings, siblings=tuple(work), twin=None, gates="none", record="none", conditions=DEFAULT)
    return drive_tests(settings, work, folder, callbacks)
