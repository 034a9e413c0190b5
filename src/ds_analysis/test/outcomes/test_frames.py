# SPDX-License-Identifier: Apache-2.0
"""Exported frames against the campaign's SQLite file, read by SQL and NumPy."""

from __future__ import annotations

import sqlite3
import zlib
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas
import pyarrow.parquet as pq
import pytest
from report_campaigns import campaign_data

from ds_analysis.common.outcome_table import RoadTable
from ds_analysis.outcomes.columns import Columns
from ds_analysis.outcomes.frames import COLUMNS, write_frames
from ds_analysis.outcomes.study import import_outcomes, read_study, study_of, write_rows, write_study
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_road import generate
from ds_sim import SimulatorName
from ds_sim.conditions.model import DEFAULT, Conditions


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
