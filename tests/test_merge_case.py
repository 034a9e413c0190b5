# SPDX-License-Identifier: Apache-2.0
"""Which operator suits a campaign: how often a stated case is wrong, and what the report and `ds evaluate` say."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from benchmarks.replication.case_errors import DESIGNS, Design, rates_of
from benchmarks.replication.stored import restore
from tests.command_line import ds

from ds_analysis.paper.campaign_contents import maps_of
from ds_analysis.real.records import RealDrive, write_drives
from ds_orchestrator.campaign.folder import open_store, read_campaign
from ds_report.html_report import write_report
from ds_report.sections import merge_tables

TABLE = Path("docs/data/replication/chauffeur.parquet")
NUMBERS = 12
"""Tests of each search in a small campaign."""
CAMPAIGNS = 120
HIGHEST = 0.05 + 2.33 * (0.05 * 0.95 / CAMPAIGNS) ** 0.5
"""A rate of 5% gives a larger share in 1% of the seeds."""


@pytest.mark.parametrize("design", DESIGNS, ids=lambda design: design.name)
def test_a_case_is_rarely_wrong(design: Design) -> None:
    wrong, right = rates_of(design, 340, 8, CAMPAIGNS, seed=1)
    assert wrong <= HIGHEST
    assert right > 0.15 or not design.right


def test_evaluation_and_report_say_which_operator_suits(tmp_path: Path) -> None:
    folder, table = tmp_path / "three", pq.read_table(TABLE)
    pq.write_table(table.filter(pc.less(table["number"], NUMBERS)), tmp_path / "small.parquet")
    restore(tmp_path / "small.parquet", folder)
    found = json.loads(ds("evaluate", folder, "--json").stdout)["merge_case"]
    failed: dict[str, dict[str, bool]] = {simulator: {} for simulator in ("bullet", "softbody", "donkey")}
    for row in table.filter(pc.less(table["number"], NUMBERS)).to_pylist():
        failed[row["simulator"]].setdefault(row["road_id"], row["failed"])
    counts = [(name, sum(of_roads.values()), len(of_roads)) for name, of_roads in failed.items()]
    assert [(row["simulator"], row["failures"], row["tests"]) for row in found["rows"]] == counts
    assert found["title"] == "Which operator: product (donkey)"
    assert "read off 54 cases of our own campaigns and has not been confirmed" in found["notes"][-1]
    assert ds("report", folder).returncode == 0
    page = (folder / "report.html").read_text()
    assert found["notes"][0] in page and found["title"] in page
    assert (folder / "evaluation" / "merge_case.csv").is_file()


def test_without_a_twin_the_drives_of_the_car_decide(tmp_path: Path) -> None:
    folder, table = tmp_path / "car", pq.read_table(TABLE)
    notes = dict(table.schema.metadata)
    config = json.loads(notes[b"config"]) | {"twin": None}
    kept = table.filter(pc.and_(pc.less(table["number"], NUMBERS), pc.not_equal(table["simulator"], "donkey")))
    kept = kept.replace_schema_metadata(notes | {b"config": json.dumps(config).encode()})
    pq.write_table(kept, tmp_path / "small.parquet")
    restore(tmp_path / "small.parquet", folder)
    assert "has no twin" in ds("evaluate", folder).stderr
    on_car = [
        RealDrive(
            test_id=test_id, failed=False, outcome="completed", max_lateral_position=None, who="", when="", source=""
        )
        for test_id in dict.fromkeys(kept["test_id"].to_pylist())
    ]
    write_drives(folder, on_car[:40])
    found = json.loads(ds("evaluate", folder, "--json").stdout)["merge_case"]
    assert found["title"] == "Which operator: product (the car)" and found["rows"][-1]["simulator"] == "the car"
    with closing(open_store(folder)) as store:
        data = read_campaign(store)
    page = write_report(folder, data, maps_of(data), [], tables=merge_tables(folder, data)).read_text()
    assert found["notes"][0] in page and "Each map against the twin" not in page
