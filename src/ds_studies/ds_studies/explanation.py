# SPDX-License-Identifier: Apache-2.0
"""Why a test fails on one simulator and not on another: drives with their parts exchanged, in all combinations.

What is shared out among the parts (Shapley values) is the loss of a drive: the share of the half lane that it uses at
most, and 1 if it fails in any way. With an outcome of 0 or 1, chosen against before anything was measured, a part that
takes a drive close to the edge would look innocent, and many failures would end in a tie.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from pathlib import Path
from typing import Any

from ds_analysis.failures import Groups
from ds_base.errors import RunError
from ds_base.table import Column, Table, styled
from ds_base.words import listed
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.engines.drive_tests import Callbacks, DriveResults, drive_tests
from ds_orchestrator.store.model import Test
from ds_sim.conditions.model import DEFAULT
from ds_sim.hybrid import PARTS, differing_parts, exchangeable, hybrid_name
from ds_sim.registry import SimulatorName, label_of

Subset = frozenset[str]
CONDITIONS = "conditions"
"""The test's conditions, exchanged for the default ones, beside the parts of simulators."""
_PLAIN = "plain-"
"""Begins the id of a test whose conditions were removed."""
NAMED = 0.6
"""Share that the parts named as the cause have together; chosen: clearly more than half."""
INNOCENT = 0.1
"""Share up to which a part is said not to be the cause; chosen: a fifth of an equal share of two."""


def subsets(parts: Sequence[str]) -> list[Subset]:
    """All subsets, the smaller ones first."""
    return [frozenset(s) for s in chain.from_iterable(combinations(parts, n) for n in range(len(parts) + 1))]


def shapley(parts: Sequence[str], value: Mapping[Subset, float]) -> dict[str, float]:
    """Shapley value of every part, from the value of every subset of the parts (Shapley 1953).

    It is what a part adds to those before it, in the mean over all orders.

    Examples:
        >>> both_needed = {s: float(len(s) == 2) for s in subsets(("camera", "look"))}
        >>> shapley(("camera", "look"), both_needed)
        {'camera': 0.5, 'look': 0.5}
    """
    n = len(parts)
    shares = {}
    for part in parts:
        others = subsets([other for other in parts if other != part])
        weights = [math.factorial(len(s)) * math.factorial(n - 1 - len(s)) / math.factorial(n) for s in others]
        shares[part] = math.fsum(w * (value[s | {part}] - value[s]) for w, s in zip(weights, others, strict=True))
    return shares


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Why a test fails on one simulator and not on another."""

    test_id: str
    fails: SimulatorName
    against: SimulatorName  # simulator on which it completes
    # Each subset of the parts in which the two differ -> loss of the drive with these of `fails`, all others of
    # `against`. A drive with the loss 1 fails.
    losses: Mapping[Subset, float]

    @property
    def repeats(self) -> bool:
        """Whether the exchange of all parts, and that of none, end as the campaign's drives did."""
        return self.losses[max(self.losses, key=len)] == 1.0 > self.losses[frozenset()]

    @property
    def shares(self) -> dict[str, float]:
        """Part -> share of the failure, the largest first; their sum is 1, and there are none unless it repeats."""
        if not self.repeats:
            return {}
        values = shapley([part for subset in self.losses if len(subset) == 1 for part in subset], self.losses)
        return {
            part: values[part] / (1.0 - self.losses[frozenset()]) for part in sorted(values, key=lambda p: -values[p])
        }

    def brings(self, part: str) -> bool:
        """Whether this part of `fails` alone makes the drive on `against` fail."""
        return self.losses[frozenset((part,))] == 1.0

    def cures(self, part: str) -> bool:
        """Whether this part of `against` alone makes the drive on `fails` complete."""
        return self.losses[max(self.losses, key=len) - {part}] < 1.0

    def document(self) -> dict[str, Any]:
        """Convert to JSON values; a drive is named by the parts that are those of `fails`."""
        drives = [
            {"parts": sorted(subset), "loss": loss, "failed": loss == 1.0} for subset, loss in self.losses.items()
        ]
        return {
            "test_id": self.test_id,
            "fails": self.fails,
            "against": self.against,
            "sentence": self.sentence,
            "shares": self.shares,
            "drives": drives,
        }

    def table(self) -> Table:
        """Tabulate the parts, the largest share first."""
        end = {True: "fails", False: "completes"}
        return Table(
            name=f"explanation_{self.test_id}_{label_of(self.fails)}",
            title=f"{self.test_id}: fails on {self.fails}, not on {self.against} ({len(self.losses)} drives)",
            columns=[
                Column("part"),
                Column("share", "number"),
                *styled("text", f"alone on {self.against}", f"{self.fails} without it"),
            ],
            rows=[(p, share, end[self.brings(p)], end[not self.cures(p)]) for p, share in self.shares.items()],
        )

    @property
    def sentence(self) -> str:
        """The cause in words."""
        if not self.repeats:
            return (
                f"{self.test_id}: the drives do not repeat, which fail on {self.fails} and complete on {self.against} "
                "in the campaign: its code, network or car has changed, or a simulator is more than its parts."
            )
        shares, named = self.shares, list[str]()
        for part in shares:
            if sum(shares[one] for one in named) < NAMED:
                named.append(part)
        words = {part: f"the {part} ({share:.2f})" for part, share in shares.items()}
        partly = [words[part] for part in shares if part not in named and shares[part] > INNOCENT]
        innocent = [part for part in shares if part not in named and abs(shares[part]) <= INNOCENT]
        because = listed([words[part] for part in named])
        because += f", partly {listed(partly)}" if partly else ""
        because += f", not the {listed(innocent, 'or')}" if innocent else ""
        cures = [
            f"default {CONDITIONS}" if part == CONDITIONS else f"the {part} of {self.against}"
            for part in filter(self.cures, shares)
        ]
        cured = f"With {listed(cures, 'or')} alone it completes"
        cured = cured if cures else f"No single part of {self.against} makes it complete"
        return f"{self.test_id} fails on {self.fails} because of {because}. {cured} there."


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One failed test, the simulator that completes it, and word for what is exchanged -> parts of simulators."""

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
            share = execution.max_lateral_position / (test.road.lane_width / 2)
            losses[subset] = 1.0 if execution.outcome.is_failure else min(share, math.nextafter(1.0, 0.0))
        return Explanation(test_id=self.test.test_id, fails=self.fails, against=self.against, losses=losses)


class ExplanationError(RunError):
    """A drive of an experiment gave no outcome."""


def experiment_on(
    data: CampaignData, test_id: str, fails: SimulatorName | None = None, against: SimulatorName | None = None
) -> Experiment:
    """Plan the exchanges for one test of a campaign, between simulators on which it fails and completes.

    By default, these are the first that fails, and the one that completes closest to the lane's middle. `ConfigError`
    if there are no such ones, `ValueError` if the parts of one cannot be exchanged.
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
    """Drive experiments on their own simulators, ungated and unrecorded; errors are those of `drive_tests`."""
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
