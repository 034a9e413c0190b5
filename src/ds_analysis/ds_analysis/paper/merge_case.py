# SPDX-License-Identifier: Apache-2.0
"""Says which merge operator suits a campaign, from how often siblings and twin (or car) fail on the same tests.

A product of failure probabilities (paper 3.5) only removes alarms, so it can pay only where every sibling fails more
often than what it predicts. `python -m benchmarks.replication.pays` computes the 54 cases off which the rule was read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from ds_analysis.common.statistics import Bools, Indices, families_of
from ds_base.intervals import jeffreys_interval
from ds_base.table import Column, Table
from ds_orchestrator.campaign.folder import CampaignData

Advice = Literal["product", "mean", "hardest sibling", "drive"]
ERROR_RATE = 0.05
"""Share of campaigns in which a case may be wrong. A case needs all siblings to differ, so it is that of one test."""
SIGNIFICANT = 0.03
"""Level of a sibling's test; chosen: below the error rate, which failures of whole families raise (simulated)."""
FLIPS = 9_999
"""Random sign flips of the test; chosen: p-values near 0.05 are accurate to 0.002."""
CAR = "the car"
_CAUTION = (
    "The rule was read off 54 cases of our own campaigns and has not been confirmed on others. "
    f"Where a sibling in truth fails equally often, a case is stated in at most {100 * ERROR_RATE:.0f}% of campaigns."
)


class FailureRate(NamedTuple):
    """How often a simulator fails; a sibling less often than the truth (-1), more often (1) or not decided (0)."""

    simulator: str
    failures: int
    tests: int
    against: int = 0
    p: float | None = None

    def __str__(self) -> str:
        return f"{self.simulator} {self.failures} ({100 * self.failures / self.tests:.0f}%)"


class MergeCase(NamedTuple):
    """Rates of the siblings, and of the truth: the twin or the car."""

    truth: FailureRate
    siblings: Sequence[FailureRate]

    @property
    def advice(self) -> Advice:
        """Operator that suits the case, or `drive` if the siblings never fail or the counts decide nothing."""
        signs = {one.against for one in self.siblings}
        if 0 in signs or not any(one.failures for one in self.siblings):
            return "drive"
        return "mean" if len(signs) == 2 else "product" if signs == {1} else "hardest sibling"

    @property
    def sentence(self) -> str:
        """Failure rates, the case, and which operator follows."""
        truth, hardest = self.truth.simulator, max(self.siblings, key=lambda one: one.failures)
        undecided = [one.simulator for one in self.siblings if not one.against]
        fail = f"{' and '.join(undecided)} fail{'s' * (len(undecided) == 1)}"
        drive = f"It is not decided whether {fail} more or less often than {truth}. Drive {truth} on more roads."
        if not hardest.failures:
            drive = f"No sibling fails, so they do not know where {truth} fails. Drive {truth}."
        sentence = {
            "product": f"Every sibling fails more often than {truth}. A product removes alarms, so it can pay here.",
            "mean": f"Some siblings fail more often than {truth}, others less often. Take the mean, not the product.",
            "hardest sibling": f"Every sibling fails less often than {truth}. A product would miss more failures. "
            f"Use {hardest.simulator} alone.",
            "drive": drive,
        }[self.advice]
        return f"Failures in {self.truth.tests} tests: {', '.join(map(str, (*self.siblings, self.truth)))}. {sentence}"


def merge_case(failed: Mapping[str, Bools], truth: str, families: Indices) -> MergeCase:
    """Compare siblings with the truth, one of the names: (tests,) failures of each, and each test's family."""
    failures, siblings = {name: int(values.sum()) for name, values in failed.items()}, []
    for name in [name for name in failed if name != truth]:
        p = _p_of_equal_rates(failed[name], failed[truth], families)
        sign = int(np.sign(failures[name] - failures[truth]))
        siblings.append(FailureRate(name, failures[name], len(families), sign if p <= SIGNIFICANT else 0, p))
    return MergeCase(FailureRate(truth, failures[truth], len(families)), siblings)


def _p_of_equal_rates(one: Bools, other: Bools, families: Indices) -> float:
    """p-value of equal rates, from flipped signs of whole families; one more is taken to say the opposite."""
    differences = np.bincount(families, one.astype(np.float64) - other)
    differences = np.append(differences, -np.sign(differences.sum()) * round(len(families) / len(np.unique(families))))
    sizes, counts = np.unique(np.abs(differences[differences != 0]), return_counts=True)
    flipped = 2 * np.random.default_rng(0).binomial(counts, 0.5, (FLIPS, len(counts))) - counts
    return float((1 + np.sum(np.abs(flipped @ sizes) >= abs(differences.sum()))) / (1 + FLIPS))


def merge_cases(data: CampaignData, driven: Mapping[str, bool]) -> list[MergeCase]:
    """Cases of a campaign against its twin, and against the car by its drives (test -> whether it failed).

    Empty with a single sibling or without common tests. A scenario counts once.
    """
    failed: dict[str, dict[str, bool]] = {test.test_id: {} for test in data.tests}
    for (test_id, simulator), has_failed in data.failed.items():
        failed[test_id][simulator] = has_failed
    for test_id in failed.keys() & driven.keys():
        failed[test_id][CAR] = driven[test_id]
    cases = []
    for truth in (data.config.twin, CAR) if len(data.config.siblings) > 1 else ():
        names = [*data.config.siblings, truth or ""]
        of_tests = [test for test in data.tests if failed[test.test_id].keys() >= set(names)]
        tests = replace(data, tests=tuple(of_tests)).distinct.tests
        if tests:
            verdicts = {name: np.array([failed[test.test_id][name] for test in tests]) for name in names}
            cases.append(merge_case(verdicts, names[-1], families_of([test.road for test in tests])))
    return cases


def merge_case_table(cases: Sequence[MergeCase]) -> Table:
    """Tabulate cases, with a sentence for each below."""
    words = ("not decided", "more often", "less often")
    return Table(
        name="merge_case",
        title=f"Which operator: {'; '.join(f'{case.advice} ({case.truth.simulator})' for case in cases)}",
        columns=[
            *map(Column, ("against", "simulator")),
            *(Column(name, "count") for name in ("failures", "tests")),
            Column("rate, 95 %", "number"),
            Column("fails"),
            Column("p", "p"),
        ],
        rows=[
            [case.truth.simulator, *one[:3], jeffreys_interval(*one[1:3]), words[one.against] if one.p else "", one.p]
            for case in cases
            for one in (*case.siblings, case.truth)
        ],
        notes=[*(case.sentence for case in cases), _CAUTION],
    )
