# SPDX-License-Identifier: Apache-2.0
"""Test files of SBFT's competition become a study, two studies are compared, and campaigns are exported as frames."""

from __future__ import annotations

import json
import sqlite3
import zlib
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas
import pandas as pd
import pyarrow.parquet as pq
import pytest
from report_campaigns import campaign_data

from ds_analysis.common.outcome_table import OutcomeTableError, RoadTable
from ds_analysis.comparison.analysis import answer_of
from ds_analysis.comparison.tables import document_of, drive_table, markdown_of
from ds_analysis.outcomes.columns import Columns, ImportNotes
from ds_analysis.outcomes.frames import COLUMNS, write_frames
from ds_analysis.outcomes.sbft import read_competition
from ds_analysis.outcomes.study import import_outcomes, read_study, study_of, write_rows, write_study
from ds_analysis.outcomes.study_results import compare_studies
from ds_base.words import LeftOut
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_road import generate
from ds_sim import SimulatorName
from ds_sim.conditions.model import DEFAULT, Conditions


def arc(radius: float, degrees: float) -> list[list[float]]:
    angles = np.linspace(0.0, np.radians(degrees), 40)
    return [[float(radius * np.sin(a)), float(radius * (1 - np.cos(a)))] for a in angles]


def write(path: Path, points: list[list[float]], outcome: str, **more: object) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"id": 1, "is_valid": True, "road_points": points, "test_outcome": outcome, **more}))


def test_a_folder_of_the_competition_is_a_simulator_and_its_road_has_the_features_of_an_arc(tmp_path: Path) -> None:
    for simulator, limit in (("beamng", 30.0), ("dave2", 20.0)):
        for radius in range(15, 60, 3):
            outcome = "FAIL" if radius < limit else "PASS"
            write(tmp_path / simulator / f"test.{radius:04d}.json", arc(radius, 90.0), outcome)
        write(tmp_path / simulator / "test.9000.json", arc(40.0, 30.0), "ERROR")
        write(tmp_path / simulator / "test.9001.json", arc(41.0, 30.0), "FAIL", is_valid=False)
    write(tmp_path / "beamng" / "again.json", arc(15, 90.0), "PASS")
    study = import_outcomes([tmp_path / "beamng", tmp_path / "dave2"], Columns())
    assert study.simulators == ["beamng", "dave2"] and list(study.axes) == ["total_turn", "largest_curvature"]
    assert {name: found[:2] for name, found in study.flakiness().items()} == {"beamng": (15, 16), "dave2": (15, 15)}
    assert study.flakiness()["beamng"][3] == 1.0  # the one test that was repeated
    (tmp_path / "dave2" / "test.9002.json").write_text("{")
    notes = ImportNotes(rows=LeftOut("rows"))
    assert import_outcomes([tmp_path / "beamng", tmp_path / "dave2"], Columns(), notes).rows.equals(study.rows)
    assert notes.rows.line().startswith("1 of 32 rows left out: ") and "test.9002.json (" in notes.rows.line()
    (tmp_path / "dave2" / "test.9002.json").unlink()
    rows = read_competition([tmp_path / "dave2"])
    for radius, (_, row) in zip(range(15, 60, 3), rows.iterrows(), strict=True):
        assert row.total_turn == pytest.approx(90.0, rel=0.1)
        assert row.largest_curvature == pytest.approx(1 / radius, rel=0.2)
        assert row.length == pytest.approx(radius * np.pi / 2, rel=0.01)
        assert row.failed == (radius < 20.0)


@pytest.mark.parametrize("with_margin", [True, False])
def test_two_studies_are_compared_on_the_tests_that_both_have(tmp_path: Path, with_margin: bool) -> None:
    speed = np.linspace(5.0, 15.0, 40)
    for name, limit in (("old", 14.0), ("new", 11.0)):
        rows = [(f"t{k}", sim, v > limit, v / limit, v, k % 3) for k, v in enumerate(speed) for sim in ("a", "b")]
        frame = pd.DataFrame(rows, columns=["test_id", "simulator", "failed", "margin", "speed", "kind"])
        frame.iloc[: 80 if name == "old" else 70].to_csv(tmp_path / "t.csv", index=False)
        (tmp_path / name).mkdir()
        given = {"margin": {"column": "margin", "limit": 1.0}} if with_margin else {}
        columns = Columns.model_validate({"features": ["speed", "kind"], **given})
        write_study(tmp_path / name, import_outcomes([tmp_path / "t.csv"], columns))
    found = compare_studies(tmp_path / "old", tmp_path / "new")
    expected = sum((speed[:35] > 11.0) & (speed[:35] <= 14.0))
    for row in found.simulators:
        assert (row.counts.tests, row.counts.newly_fail, row.counts.fixed) == (35, expected, 0)
        assert (row.margin_change is None) is not with_margin
    assert answer_of(found) == "Merge? No: it is worse." and len(found.simulators) == 2
    json.dumps(document_of(found, {}), allow_nan=False)
    assert "nan" not in markdown_of(found, {}) and len(drive_table(found).rows) == 70
    frame.assign(test_id="x" + frame.test_id).to_csv(tmp_path / "t.csv", index=False)
    write_study(tmp_path / "new", import_outcomes([tmp_path / "t.csv"], columns))
    with pytest.raises(OutcomeTableError, match="share no test"):
        compare_studies(tmp_path / "old", tmp_path / "new")


def test_frames_are_the_stored_trajectories(tmp_path: Path) -> None:
    data = campaign_data(tmp_path, CampaignConfig(), 4)
    path = write_frames(tmp_path / "tables", data)
    frames = pandas.read_parquet(path)
    with closing(sqlite3.connect(tmp_path / "campaign.sqlite")) as db:
        stored = db.execute("SELECT test_id, simulator, steps, trajectory FROM executions").fetchall()
    assert len(frames) == sum(steps + 1 for _, _, steps, _ in stored)
    for test, simulator, steps, packed in stored[::7]:
        rows = frames[(frames["test_id"] == test) & (frames["simulator"] == simulator)]
        expected = np.frombuffer(zlib.decompress(packed)).reshape(-1, 5)
        assert np.array_equal(rows[["x", "y", "yaw", "speed", "lateral_position"]].to_numpy(), expected)
        assert list(rows["step"]) == list(range(steps + 1)) and rows["time"].iloc[-1] == pytest.approx(steps / 20)
        assert rows["steering"].notna().sum() == steps and np.isnan(rows["steering"].iloc[-1])
    assert write_frames(tmp_path / "again", data).read_bytes() == path.read_bytes()
    assert [field.metadata[b"unit"].decode() for field in pq.read_schema(path)] == [u for _, u, _ in COLUMNS.values()]
    assert pq.read_table(write_frames(tmp_path / "none", CampaignData(config=data.config))).num_rows == 0


def test_an_export_has_a_column_for_each_condition_that_was_changed(tmp_path: Path) -> None:
    roads = [generate(np.random.default_rng(seed)) for seed in range(4)]
    conditions = [DEFAULT, Conditions(visibility=60.0), Conditions(friction=0.5, speed_limit=8.0), DEFAULT]
    states = np.array([[1, 2]] * 4, np.int8)
    table = RoadTable.of(
        roads, states, np.ones((4, 2)), siblings=[SimulatorName("a"), SimulatorName("b")], conditions=conditions
    )
    study = study_of(table)
    write_study(tmp_path, study)
    of_a = pandas.read_parquet(tmp_path / "outcomes.parquet").query("simulator == 'a'")
    assert of_a["condition_visibility"].tolist() == [np.inf, 60.0, np.inf, np.inf]
    assert of_a["condition_friction"].tolist() == [1.0, 1.0, 0.5, 1.0]
    assert of_a["condition_speed_limit"].isna().tolist() == [True, True, False, True]
    assert of_a["condition_speed_limit"].iloc[2] == 8.0
    assert len([name for name in of_a if name.startswith("condition_")]) == 3
    assert read_study(tmp_path).features == table.feature_names  # as before: shares of ranges
    for suffix in ("csv", "parquet"):  # no feature either when it comes back
        write_rows(tmp_path / f"t.{suffix}", read_study(tmp_path))
        again = import_outcomes([tmp_path / f"t.{suffix}"], Columns())
        pandas.testing.assert_frame_equal(again.rows, study.rows, check_dtype=False)
        assert again.conditions == study.conditions
