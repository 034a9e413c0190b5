# SPDX-License-Identifier: Apache-2.0
"""Fast versions of the studies in `benchmarks`: claims, predictions on the shipped tables, and when to merge.

Claims are hardly ever made under noise, mostly under a clear effect (docs/claims.md). An error rate may exceed 5% by
two standard errors of the number of campaigns.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks import claims
from benchmarks.claims import EFFECTS, NOISES
from benchmarks.predictors import KINDS, OURS, answers, behind, cars_of, made, score
from benchmarks.replication.stored import read, write_table
from benchmarks.replication.tables import of_runs, third_table
from benchmarks.when_to_merge import plan
from benchmarks.when_to_merge.analysis import cases_of, load
from benchmarks.when_to_merge.plan import SIBLINGS

from ds_analysis.paper.campaign_contents import maps_of
from ds_analysis.paper.correlation import evaluate
from ds_analysis.prediction.mixture import predict
from ds_base.table import Value
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import MapId
from ds_sim import SimulatorName


def stated(row: Sequence[Value]) -> float:
    """Share of campaigns in which the claim is made."""
    assert isinstance(row[5], float)
    return row[5]


def at_most(campaigns: int) -> float:
    return 0.05 + 2.0 * float(np.sqrt(0.05 * 0.95 / campaigns))


@pytest.mark.parametrize("size", [24, 40])
@pytest.mark.parametrize("noise", NOISES, ids=lambda one: one.name)
def test_a_split_is_hardly_ever_stated_under_noise(size: int, noise: claims.Effect) -> None:
    assert stated(claims.splits(size, 3, noise, 150)) <= at_most(150)


def test_a_clear_effect_is_stated_with_intervals_that_cover() -> None:
    row = claims.splits(40, 3, EFFECTS[0], 100)
    covered = [share for share in row[-2:] if isinstance(share, float)]
    assert stated(row) > 0.85 and len(covered) == 2 and min(covered) >= 0.95


def test_a_second_split_is_hardly_ever_stated_without_an_effect() -> None:
    assert stated(claims.second_splits(40, 3, NOISES[0], 100)) <= at_most(100)


@pytest.mark.parametrize("siblings", [2, 4])
def test_a_sibling_is_believed_only_if_it_follows_the_twin(siblings: int) -> None:
    assert stated(claims.beliefs(40, siblings, 0.0, 200)) <= at_most(200)
    assert stated(claims.beliefs(40, siblings, 0.9, 50)) > 0.9


def test_a_way_of_failing_leads_only_if_it_does() -> None:
    assert stated(claims.most_often(40, 0.25, 300)) <= at_most(300)
    assert stated(claims.most_often(40, 0.7, 100)) > 0.5


def test_networks_that_are_alike_are_hardly_ever_called_worse_or_better() -> None:
    for row in claims.verdicts(40, 0.0, 15):
        assert stated(row) <= at_most(15)


def test_a_network_that_fails_far_more_often_is_mostly_called_worse() -> None:
    """The table has 0.64; where simulators' names are not those of the drives, none is called so."""
    (row,) = claims.verdicts(40, 0.5, 10)
    assert stated(row) > 0.5


@pytest.fixture(scope="module")
def ours() -> list[Path]:
    return sorted(one.parent for one in OURS.glob("*/outcomes.parquet"))


def test_no_simple_rule_is_much_better_on_any_table(ours: list[Path]) -> None:
    """Never more than 0.02 behind the best of five after 4 and 8 drives, 0.01 in the mean, 0.035 without a drive."""
    scored = {folder.name: [score(hidden, failed) for _, hidden, failed in cars_of(folder)] for folder in ours}
    distances = {name: behind(cars) for name, cars in scored.items()}
    assert len(distances) >= 6
    for budget, most in ((0, 0.035), (4, 0.02), (8, 0.02)):
        assert max(of[budget] for of in distances.values()) <= most, distances
        assert np.mean([of[budget] for of in distances.values()]) <= 0.01
    calls = np.sum([car.calls[8] for cars in scored.values() for car in cars], axis=0)
    safe, failed, fails, completed, intervals, hold = calls
    assert safe > 1000 and failed / safe <= 0.05 and fails > 100 and completed / fails <= 0.05
    assert hold / intervals >= 0.85


def test_it_says_whether_siblings_have_helped(ours: list[Path]) -> None:
    """Siblings predict a car as it is, and not one that does not follow them; a false praise is rare."""
    said: Counter[tuple[str, str]] = Counter()
    for folder in ours[:5]:
        for _, hidden, failed in cars_of(folder):
            prediction = predict(hidden)
            for k, kind in enumerate(KINDS):
                outcomes = made(hidden, failed, kind, np.random.default_rng([3, k]))
                for budget, answer in answers(prediction, outcomes, [8, k]):
                    said[kind, answer] += budget == 50
    cars = sum(said["control", answer] for answer in ("helped", "misled", "open"))
    assert cars == 15 and said["control", "helped"] <= 2 and said["opposite", "helped"] <= 1
    assert said["as it is", "helped"] >= 8 and said["as it is", "misled"] == 0
    assert said["other", "misled"] >= 10 and said["other", "helped"] == 0


def only(data: CampaignData, tests: Collection[str]) -> CampaignData:
    """Keep some tests of a campaign, by their identifiers."""
    executions = tuple(one for one in data.executions if one.test_id in tests)
    return replace(data, tests=tuple(one for one in data.tests if one.test_id in tests), executions=executions)


def test_maps_of_the_study_have_the_papers_r_and_auc_prc(tmp_path: Path) -> None:
    data = of_runs(read(third_table("epoch")), {0})  # outcomes that were known before the study
    drawn = plan.drawn({test.test_id: test.sibling for test in data.tests})
    maps = maps_of(only(data, drawn))
    block = load("epoch", False, tmp_path)
    # Any of the simulators as the twin: the study's own are driven later.
    first, second, twin = map(SimulatorName, SIBLINGS)
    (case,) = cases_of({"epoch": block}, [(twin, (first, second))], 1, with_auc=True)
    truth = {MapId.twin(twin): maps[MapId.union(twin)]}
    campaign = of_runs(read(third_table("epoch").with_name("epoch.parquet")), {0})
    merged = maps_of(only(campaign, drawn))[MapId.merged()]
    unions = {MapId.union(one): maps[MapId.union(one)] for one in (first, second)}
    found = evaluate({**unions, MapId.merged(): merged, **truth}, [first, second], twin)
    by_r = [one.r or 0.0 for one in found if one.value == "probability"]
    by_auc = [one.auc or 0.0 for one in found if one.value == "probability"]
    assert [case.r[name] for name in ("first", "second", "product")] == pytest.approx(by_r)
    assert case.gain_auc[0] == pytest.approx(by_auc[2] - max(by_auc[:2]))
    assert case.gain[0] == pytest.approx(by_r[2] - max(by_r[:2]))
    assert np.isfinite(case.gain).all()


def test_a_table_of_a_campaign_gives_the_campaign_again(tmp_path: Path) -> None:
    data = of_runs(read(third_table("epoch")), {0})
    write_table(data, tmp_path / "table.parquet")
    again = read(tmp_path / "table.parquet")
    assert (again.tests, again.config) == (data.tests, data.config) and maps_of(again) == maps_of(data)


def test_the_page_says_what_the_table_of_cases_says() -> None:
    with Path("docs/data/when_to_merge_plain.csv").open(newline="") as file:
        cases = list(csv.DictReader(file))
    page = " ".join(Path("docs/when_to_merge.md").read_text().split())
    better = sum(float(case["low"]) > 0 for case in cases)
    worse = [sum(float(one["high"]) < 0 for one in cases if one["both_harder"] == kind) for kind in ("True", "False")]
    both = sum(case["both_harder"] == "True" for case in cases)
    assert better == 0 and f"in none of {len(cases)} cases" in page and f"in {sum(worse)} it was worse" in page
    assert f"| {both} | 4 | -0.03 (-0.30 to +0.23) | 0 | {worse[0]} |" in page
    assert f"| {len(cases) - both} | 5 | **-0.22** (-0.31 to -0.12) | 0 | {worse[1]} |" in page
