# SPDX-License-Identifier: Apache-2.0
"""Exported tables against the campaign's SQLite file, read by SQL and NumPy, and against the documentation."""

from __future__ import annotations

import csv
import json
import sqlite3
import zlib
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas
import pyarrow.parquet as pq
import pytest
from report_campaigns import make_campaign

from ds_analysis.common.parquet import EXECUTIONS, FRAMES, write_tables
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData, read_campaign
from ds_road import read_roads
from ds_sim.gates.gate import Gate, GateState

CONFIG = CampaignConfig(siblings=["bullet", "softbody"], twin="donkey", driver="dave2")
COLUMNS = Path(__file__).resolve().parents[3] / "docs" / "data" / "parquet_columns.csv"


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CampaignData]:
    folder = tmp_path_factory.mktemp("campaign")
    with closing(make_campaign(folder, CONFIG, 4, bags=True)) as store:
        data = read_campaign(store)
    return folder, data


@pytest.fixture(scope="module")
def tables(campaign: tuple[Path, CampaignData], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tables")
    assert [path.name for path in write_tables(campaign[1], folder, frames=True)] == [
        "executions.parquet",
        "frames.parquet",
    ]
    return folder


def test_every_execution_is_a_row_with_the_stores_values(campaign: tuple[Path, CampaignData], tables: Path) -> None:
    with closing(sqlite3.connect(campaign[0] / "campaign.sqlite")) as store:
        stored = store.execute(
            "SELECT test_id, simulator, outcome, fitness, max_lateral_position, steps, bag, trajectory_sha256 "
            "FROM executions ORDER BY test_id, simulator"
        ).fetchall()
    found = pandas.read_parquet(tables / "executions.parquet").astype({"simulator": str})
    found = found.sort_values(["test_id", "simulator"])
    names = ["test_id", "simulator", "outcome", "fitness", "max_lateral_position", "steps", "bag", "trajectory_sha256"]
    assert len(stored) == 24 and [tuple(row) for row in found[names].itertuples(index=False)] == [
        (test, simulator, outcome, *rest) for test, simulator, outcome, *rest in stored
    ]
    assert list(found["failed"]) == [row[2] == "OUT_OF_BOUNDS" for row in stored] and found["failed"].any()
    assert set(found["simulator"][found["is_twin"]]) == {"donkey"} and set(found["driver"]) == {"dave2"}
    assert found["gate"].isna().all()


def test_a_rows_road_and_cell_are_those_of_its_test(campaign: tuple[Path, CampaignData], tables: Path) -> None:
    tests = {test.test_id: test for test in campaign[1].tests}
    for row in pq.read_table(tables / "executions.parquet").to_pylist():
        (road,) = read_roads(row["road"])
        assert road == tests[row["test_id"]].road and road.road_id == row["road_id"]
        assert row["cell"] == [row["turns_count"], int(100 * row["curvature"])]


def test_frames_are_the_stored_trajectories(campaign: tuple[Path, CampaignData], tables: Path) -> None:
    found = pandas.read_parquet(tables / "frames.parquet")
    with closing(sqlite3.connect(campaign[0] / "campaign.sqlite")) as store:
        stored = store.execute("SELECT test_id, simulator, steps, trajectory FROM executions").fetchall()
    assert len(found) == sum(steps + 1 for _, _, steps, _ in stored)
    for test, simulator, steps, packed in stored[::7]:
        rows = found[(found["test_id"] == test) & (found["simulator"] == simulator)]
        expected = np.frombuffer(zlib.decompress(packed)).reshape(-1, 5)
        assert np.array_equal(rows[["x", "y", "yaw", "speed", "lateral_position"]].to_numpy(), expected)
        assert list(rows["step"]) == list(range(steps + 1)) and rows["time"].iloc[-1] == pytest.approx(steps / 20)
        assert rows["steering"].notna().sum() == steps and np.isnan(rows["steering"].iloc[-1])


def test_excluded_tests_have_a_row_without_outcome(campaign: tuple[Path, CampaignData], tmp_path: Path) -> None:
    data = campaign[1]
    left_out = data.executions[0]
    gate = Gate(state=GateState.OUT_OF_ODD, message="too dark")
    changed = CampaignData(
        config=CONFIG,
        tests=data.tests,
        executions=data.executions[1:],
        gates={(left_out.test_id, left_out.simulator): gate},
    )
    (path,) = write_tables(changed, tmp_path)
    (row,) = (row for row in pq.read_table(path).to_pylist() if row["gate"] is not None)
    assert (row["test_id"], row["simulator"]) == (left_out.test_id, left_out.simulator)
    assert (row["gate"], row["gate_message"]) == ("out_of_odd", "too dark")
    assert row["outcome"] is row["failed"] is row["fitness"] is row["trajectory_sha256"] is None


def test_the_same_campaign_gives_the_same_bytes(
    campaign: tuple[Path, CampaignData], tables: Path, tmp_path: Path
) -> None:
    for path in write_tables(campaign[1], tmp_path, frames=True):
        assert path.read_bytes() == (tables / path.name).read_bytes()
    empty = write_tables(CampaignData(config=CONFIG), tmp_path / "empty", frames=True)
    assert [pq.read_table(path).num_rows for path in empty] == [0, 0]


def test_columns_are_documented_in_the_files_and_in_the_documentation(tables: Path) -> None:
    with COLUMNS.open(newline="") as rows:
        documented = list(csv.DictReader(rows))
    for file, columns in (("executions", EXECUTIONS), ("frames", FRAMES)):
        schema = pq.read_schema(tables / f"{file}.parquet")
        assert schema.names == [column.name for column in columns]
        assert [(column.name, column.unit, column.description) for column in columns] == [
            (row["column"], row["unit"], row["meaning"]) for row in documented if row["file"] == file
        ]
        for column, field in zip(columns, schema, strict=True):
            assert field.metadata[b"unit"].decode() == column.unit
            assert field.metadata[b"description"].decode() == column.description
        assert json.loads(schema.metadata[b"config"])["driver"] == "dave2"
        assert json.loads(schema.metadata[b"features"]) == ["turns_count", "curvature"]
