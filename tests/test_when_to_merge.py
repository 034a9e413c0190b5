# SPDX-License-Identifier: Apache-2.0
"""The study of when to merge: its analysis computes the paper's numbers, and its plan is whole."""

import csv
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.replication.stored import read, write_table
from benchmarks.replication.tables import of_runs, third_table
from benchmarks.when_to_merge import plan
from benchmarks.when_to_merge.analysis import cases_of, load
from benchmarks.when_to_merge.plan import SIBLINGS

from ds_analysis.paper.campaign_contents import maps_of
from ds_analysis.paper.correlation import evaluate
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import MapId
from ds_sim import SimulatorName


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
    first, second, twin = SIBLINGS
    (case,) = cases_of({"epoch": block}, [(twin, (first, second))], 1, with_auc=True)
    truth = {MapId.twin(SimulatorName(twin)): maps[MapId.union(SimulatorName(twin))]}
    campaign = of_runs(read(third_table("epoch").with_name("epoch.parquet")), {0})
    merged = maps_of(only(campaign, drawn))[MapId.merged()]
    unions = {MapId.union(SimulatorName(one)): maps[MapId.union(SimulatorName(one))] for one in (first, second)}
    found = evaluate(
        {**unions, MapId.merged(): merged, **truth}, [SimulatorName(first), SimulatorName(second)], SimulatorName(twin)
    )
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
