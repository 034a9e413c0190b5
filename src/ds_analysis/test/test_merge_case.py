# SPDX-License-Identifier: Apache-2.0
"""Which operator suits a campaign: cases by hand, and p-values against SciPy's exact permutation test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_executions import made_execution
from scipy.stats import permutation_test

from ds_analysis.common.statistics import Bools
from ds_analysis.paper.merge_case import CAR, merge_case, merge_case_table, merge_cases
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.store.model import Origin, Test
from ds_road import generate
from ds_sim import BULLET, DONKEY, SOFTBODY, SimulatorName
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome


def first(failures: int, tests: int = 40) -> Bools:
    return np.arange(tests) < failures


@pytest.mark.parametrize(
    ("one", "other", "twin", "advice", "words"),
    [
        (20, 30, 8, "product", "Every sibling fails more often than donkey. A product removes alarms"),
        (30, 4, 15, "mean", "Some siblings fail more often than donkey, others less often. Take the mean"),
        (10, 4, 30, "hardest sibling", "A product would miss more failures. Use a alone."),
        (0, 0, 30, "drive", "No sibling fails, so they do not know where donkey fails. Drive donkey."),
        (0, 30, 2, "drive", "whether a fails more or less often than donkey. Drive donkey on more roads."),
        (8, 8, 8, "drive", "whether a and b fail more or less often than donkey."),
        (0, 0, 0, "drive", "No sibling fails"),
    ],
)
def test_case_and_sentence(one: int, other: int, twin: int, advice: str, words: str) -> None:
    found = merge_case({"a": first(one), "b": first(other), "donkey": first(twin)}, "donkey", np.arange(40))
    assert found.advice == advice and words in found.sentence
    rates = f"a {one} ({100 * one / 40:.0f}%), b {other} ({100 * other / 40:.0f}%), donkey {twin} "
    assert rates in found.sentence and "Failures in 40 tests: " in found.sentence


def test_p_values_are_those_of_an_exact_permutation_of_families() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        families = np.sort(rng.integers(0, 9, 40))
        one, twin = rng.random(40) < 0.5, rng.random(40) < 0.25
        sums = [np.bincount(families, values, 9) for values in (one, twin)]
        # One more family of average size that says the opposite.
        average = round(40 / len(set(families.tolist())))
        fewer = int(one.sum() > twin.sum())
        sums = [np.append(values, average * (k == fewer)) for k, values in enumerate(sums)]
        exact = permutation_test(
            sums, lambda x, y: abs(np.sum(x - y)), permutation_type="samples", alternative="greater", n_resamples=np.inf
        )
        found = merge_case({"a": one, "twin": twin}, "twin", families).siblings[0]
        assert found.p == pytest.approx(exact.pvalue, abs=0.02)
        assert found.against == (0 if exact.pvalue > 0.03 else 1 if one.sum() > twin.sum() else -1) or (
            abs(exact.pvalue - 0.03) < 0.02
        )


def campaign(tests: int, copies: int) -> CampaignData:
    """Distinct roads, and copies of the first; a fails on all, b on every second, the twin on none."""
    roads = [generate(np.random.default_rng(number)) for number in range(tests)]
    made = [
        Test(f"a-0-{number:04d}", Scenario(road, seed=number), Origin(SimulatorName("a"), 0, number))
        for number, road in enumerate([*roads, *roads[:1] * copies])
    ]
    executions = [
        made_execution(test.test_id, name, Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED)
        for test in made
        for name, failed in (("a", True), ("b", test.number % 2 == 0), ("donkey", False))
    ]
    config = CampaignConfig(siblings=[BULLET, SOFTBODY], twin=DONKEY).model_copy(update={"siblings": ["a", "b"]})
    return CampaignData(config=config, tests=tuple(made), executions=tuple(executions))


def test_a_road_counts_once_and_the_car_is_compared_on_its_own_tests() -> None:
    data = campaign(20, copies=5)
    (twin,) = merge_cases(data, {})
    assert [(one.failures, one.tests) for one in (*twin.siblings, twin.truth)] == [(20, 20), (10, 20), (0, 20)]
    assert twin.advice == "product"
    driven = {test.test_id: test.number < 2 for test in data.tests[:16]}
    _, car = merge_cases(data, driven | {"unknown": True})
    assert [(one.failures, one.tests) for one in (*car.siblings, car.truth)] == [(16, 16), (8, 16), (2, 16)]
    assert car.truth.simulator == CAR and car.advice == "drive" and "Drive the car on more roads." in car.sentence
    # The copy of a road that the car has driven is the same road.
    copied = {data.tests[-1].test_id: True, data.tests[0].test_id: False}
    assert [case.truth.tests for case in merge_cases(data, copied)] == [20, 1]
    table = merge_case_table([twin, car])
    assert table.title == "Which operator: product (donkey); drive (the car)" and len(table.rows) == 6
    assert [row[5] for row in table.rows] == ["more often", "more often", "", "more often", "not decided", ""]
    assert "has not been confirmed on others" in table.notes[-1] and table.csv() and table.latex()


def test_nothing_to_merge_or_to_compare() -> None:
    data = campaign(6, copies=0)
    single = data.config.model_copy(update={"siblings": ["a"]})
    assert merge_cases(replace(data, config=single), {}) == []
    alone = data.config.model_copy(update={"twin": None})
    assert merge_cases(replace(data, config=alone), {}) == []
    assert [case.truth.simulator for case in merge_cases(replace(data, config=alone), {"a-0-0000": True})] == [CAR]
    assert merge_cases(replace(data, executions=()), {}) == []
