# SPDX-License-Identifier: Apache-2.0
"""Writes a campaign's executions, and their frames, as Parquet files, for pandas, Polars, DuckDB, Spark and others.

The same campaign gives the same bytes. Columns have units and descriptions, which the files carry too.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ds_orchestrator.campaign.folder import DRIVER_SHA256, CampaignData
from ds_orchestrator.store.model import Execution, Test
from ds_road import road_to_json
from ds_sim.conditions.text import format_conditions
from ds_sim.gates.gate import Gate
from ds_sim.simulator import FRAME_TIME

WEIGHTS_NOTE = "driver_sha256"
"""Note of a table with the digest of the driver's weights."""
FORMAT_VERSION = "1"
"""Increases when a column changes its meaning or goes; new columns may come at any time."""


class Column(NamedTuple):
    """A column of an exported table.

    Attributes:
        name: in the file.
        kind: Arrow type.
        unit: SI unit, or "".
        description: one line.
        optional: null where there is no value.
    """

    name: str
    kind: pa.DataType
    unit: str
    description: str
    optional: bool = False


_TEXT, _WHOLE, _REAL = pa.string(), pa.int64(), pa.float64()
_CATEGORY = pa.dictionary(pa.int32(), pa.string())

EXECUTIONS = (
    Column("driver", _CATEGORY, "", "driver under test, as in the configuration"),
    Column("test_id", _TEXT, "", "test: sibling, search run and number"),
    Column("sibling", _CATEGORY, "", "simulator whose search generated the test"),
    Column("run", _WHOLE, "", "index of the search run, from 0"),
    Column("number", _WHOLE, "", "index of the test within its run, from 0"),
    Column("simulator", _CATEGORY, "", "simulator that drove the test"),
    Column("is_twin", pa.bool_(), "", "whether that simulator is the campaign's twin"),
    Column("gate", _CATEGORY, "", "valid, infeasible, out_of_odd, not_applicable; null without gates", True),
    Column("gate_message", _TEXT, "", "why no network can be judged by the test there; null if it can", True),
    Column("outcome", _CATEGORY, "", "COMPLETED, OUT_OF_BOUNDS, STUCK or TIMEOUT; null if excluded", True),
    Column("failed", pa.bool_(), "", "whether the driver failed; null without outcome", True),
    Column("fitness", _REAL, "m", "smallest distance to the edge of the lane, negative outside", True),
    Column("max_lateral_position", _REAL, "m", "largest distance from the lane's centre line", True),
    Column("steps", _WHOLE, "", "frames driven, of 1/20 s", True),
    Column("simulated_seconds", _REAL, "s", "simulated time driven", True),
    Column("message", _TEXT, "", "reason for the outcome where it alone does not explain it", True),
    Column("seed", _WHOLE, "", "seed of every execution of the test"),
    Column("conditions", _TEXT, "", "operating conditions other than the default, as on the command line; else empty"),
    Column("cell", pa.list_(_WHOLE), "", "bins of the feature map, one for each feature; null if none", True),
    Column("road_id", _TEXT, "", "hash of the road"),
    Column("turns_count", _WHOLE, "", "turns of the road"),
    Column("curvature", _REAL, "1/m", "largest curvature of the centre line"),
    Column("length", _REAL, "m", "length of the centre line"),
    Column("lane", _CATEGORY, "", "driven lane: right or left"),
    Column("road", _TEXT, "", "the road as JSON, for ds road and ds drive"),
    Column("bag", _TEXT, "", "folder of the bag below the campaign's, or empty", True),
    Column("trajectory_sha256", _TEXT, "", "digest of the trajectory", True),
)
"""One row for each test on each simulator that drove it, or whose gate excluded it."""

FRAMES = (
    Column("test_id", _CATEGORY, "", "test: sibling, search run and number"),
    Column("simulator", _CATEGORY, "", "simulator that drove the test"),
    Column("step", pa.int32(), "", "frame, from 0 at rest"),
    Column("time", _REAL, "s", "simulated time"),
    Column("x", _REAL, "m", "position in the road frame"),
    Column("y", _REAL, "m", "position in the road frame"),
    Column("yaw", _REAL, "rad", "heading, counter-clockwise from x"),
    Column("speed", _REAL, "m/s", "velocity along the heading"),
    Column("lateral_position", _REAL, "m", "distance from the lane's centre line, right positive"),
    Column("steering", _REAL, "", "command to the next frame, -1 full left to 1 full right; null at the end", True),
)
"""One row for each frame of each execution."""


def schema_of(columns: tuple[Column, ...], **notes: str) -> pa.Schema:
    """Arrow schema whose fields carry unit and description, and whose metadata are the notes."""
    fields = [
        pa.field(c.name, c.kind, nullable=c.optional, metadata={"description": c.description, "unit": c.unit})
        for c in columns
    ]
    return pa.schema(fields, metadata={"format_version": FORMAT_VERSION, **notes})


EXECUTIONS_FILE = "executions.parquet"
FRAMES_FILE = "frames.parquet"
_BATCH, _ROWS = 100_000, 10_000
"""Rows of frames, and of executions, written at once; chosen: 10 MB, and 50 MB."""


def write_tables(data: CampaignData, folder: Path, *, frames: bool = False) -> list[Path]:
    """Write the tables of a campaign, finished or not.

    Args:
        data: campaign.
        folder: to write to, created if missing; files of the same name are replaced.
        frames: write a row for every frame, too.

    Returns:
        Paths of the files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    notes = {
        "config": data.config.model_dump_json(),
        "features": json.dumps(data.config.features),
    }
    if DRIVER_SHA256 in data.notes:
        notes[WEIGHTS_NOTE] = data.notes[DRIVER_SHA256]
    executions = folder / EXECUTIONS_FILE
    schema = schema_of(EXECUTIONS, **notes)
    with pq.ParquetWriter(executions, schema, compression="zstd") as writer:
        for batch in _execution_batches(data):
            writer.write_table(pa.Table.from_pylist(batch, schema=schema))
    if not frames:
        return [executions]
    path = folder / FRAMES_FILE
    schema = schema_of(FRAMES, **notes)
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for batch in _frame_batches(data):
            writer.write_table(_table(batch, schema))
    return [executions, path]


_MEASURED = ("fitness", "max_lateral_position", "steps", "simulated_seconds", "bag", "trajectory_sha256")


def _execution_batches(data: CampaignData) -> Iterator[list[dict[str, Any]]]:
    """Rows for each test on each simulator, by test and simulator in the campaign's order; one batch at least."""
    driven = {(one.test_id, one.simulator): one for one in data.executions}
    rows: list[dict[str, Any]] = []
    for test in data.tests:
        if len(rows) >= _ROWS:
            yield rows
            rows = []
        about = _about_test(data, test)
        for simulator in data.config.simulators:
            execution, gate = driven.get((test.test_id, simulator)), data.gates.get((test.test_id, simulator))
            if execution is not None or (gate is not None and not gate.is_valid):
                rows.append({**about, **_about_drive(data, simulator, execution, gate)})
    yield rows


def _about_test(data: CampaignData, test: Test) -> dict[str, Any]:
    road, cell = test.road, data.cells.get(test.test_id)
    return {
        "driver": data.config.driver,
        **{name: getattr(test, name) for name in ("test_id", "sibling", "run", "number", "seed")},
        "conditions": format_conditions(test.conditions),
        "cell": None if cell is None else list(cell),
        **{name: getattr(road, name) for name in ("road_id", "turns_count", "curvature", "length", "lane")},
        "road": json.dumps(road_to_json(road)),
    }


def _about_drive(data: CampaignData, simulator: str, execution: Execution | None, gate: Gate | None) -> dict[str, Any]:
    row: dict[str, Any] = {"simulator": simulator, "is_twin": simulator == data.config.twin}
    if gate is not None:
        row |= {"gate": gate.state.value, "gate_message": gate.message or None}
    if execution is not None:
        row |= {name: getattr(execution, name) for name in _MEASURED}
        row |= {"outcome": execution.outcome.name, "failed": execution.outcome.is_failure}
        row |= {"message": execution.message or None}
    return row


def _frame_batches(data: CampaignData) -> Iterator[list[dict[str, Any]]]:
    """Columns of executions, so many together that a batch has some `_BATCH` rows."""
    batch: list[dict[str, Any]] = []
    for one in data.executions:
        count = len(one.trajectory)
        x, y, yaw, speed, lateral = one.trajectory.T
        steering = np.full(count, np.nan)
        steering[: len(one.steering)] = one.steering[:count]
        motion = {"x": x, "y": y, "yaw": yaw, "speed": speed, "lateral_position": lateral, "steering": steering}
        drive = {"test_id": [one.test_id] * count, "simulator": [one.simulator] * count}
        batch.append({**drive, "step": np.arange(count), "time": np.arange(count) * FRAME_TIME, **motion})
        if sum(len(columns["x"]) for columns in batch) >= _BATCH:
            yield batch
            batch = []
    if batch:
        yield batch


def _table(batch: list[dict[str, Any]], schema: pa.Schema) -> pa.Table:
    arrays = []
    for field in schema:
        joined = np.concatenate([np.asarray(columns[field.name]) for columns in batch])
        # NaN stands for no value: no stored number is one.
        values = joined.tolist() if pa.types.is_dictionary(field.type) else joined
        arrays.append(pa.array(values, field.type, from_pandas=True))
    return pa.Table.from_arrays(arrays, schema=schema)
