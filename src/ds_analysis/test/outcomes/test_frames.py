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
from report_campaigns import make_campaign

from ds_analysis.outcomes.frames import COLUMNS, write_frames
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData, read_campaign

CONFIG = CampaignConfig(siblings=["bullet", "softbody"], twin="donkey", driver="dave2")


def test_frames_are_the_stored_trajectories(tmp_path: Path) -> None:
    with closing(make_campaign(tmp_path, CONFIG, 4, bags=True)) as store:
        data = read_campaign(store)
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
    assert pq.read_table(write_frames(tmp_path / "none", CampaignData(config=CONFIG))).num_rows == 0
