# SPDX-License-Identifier: Apache-2.0
"""Keeps a campaign's outcomes as a table in docs/data, and makes a campaign's folder of it again.

`python -m benchmarks.replication.stored docs/data/replication/dave2.parquet FOLDER`; then `ds evaluate FOLDER`. Frames
are not in the tables: maps, statistics and predictions are as before, replays are empty.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from contextlib import closing
from itertools import product
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ds_base.folder_files import whole_file
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.folder import (
    DRIVER_SHA256,
    CampaignData,
    open_store,
    prepare_folder,
    read_campaign,
    store_of,
)
from ds_orchestrator.store.model import NO_DRIVE, Execution, Origin, Test
from ds_road import road_from_json, road_to_json
from ds_sim.conditions.text import format_conditions, parse_conditions
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

_CATEGORY = pa.dictionary(pa.int32(), pa.string())
_TEST = {"test_id": pa.string(), "sibling": _CATEGORY, "run": pa.int64(), "number": pa.int64(), "seed": pa.int64()}
_ROAD = {
    "road_id": pa.string(),
    "turns_count": pa.int64(),
    "curvature": pa.float64(),
    "length": pa.float64(),
    "lane": _CATEGORY,
}
_DRIVE = {
    "fitness": pa.float64(),
    "max_lateral_position": pa.float64(),
    "steps": pa.int64(),
    "simulated_seconds": pa.float64(),
    "message": pa.string(),
    "trajectory_sha256": pa.string(),
}
"""Columns that are attributes of a test, of a road and of an execution."""
_OTHERS = {
    "driver": _CATEGORY,
    "simulator": _CATEGORY,
    "is_twin": pa.bool_(),
    "gate": _CATEGORY,
    "gate_message": pa.string(),
    "outcome": _CATEGORY,
    "failed": pa.bool_(),
    "conditions": pa.string(),
    "cell": pa.list_(pa.int64()),
    "road": pa.string(),
}
WEIGHTS_NOTE = "driver_sha256"


def write_table(data: CampaignData, path: Path) -> None:
    """Write a row for each test on each simulator that drove it, or whose gate excluded it; the road is JSON."""
    driven = {(one.test_id, one.simulator): one for one in data.executions}
    rows = []
    for test, simulator in product(data.tests, data.config.simulators):
        execution, gate = driven.get((test.test_id, simulator)), data.gates.get((test.test_id, simulator))
        if execution is None and (gate is None or gate.is_valid):
            continue
        row = {name: getattr(test, name) for name in _TEST} | {name: getattr(test.road, name) for name in _ROAD}
        row |= {"driver": str(data.config.driver), "simulator": simulator, "is_twin": simulator == data.config.twin}
        row |= {"conditions": format_conditions(test.conditions), "road": json.dumps(road_to_json(test.road))}
        row["cell"] = data.cells.get(test.test_id)
        if gate is not None:
            row |= {"gate": gate.state.value, "gate_message": gate.message or None}
        if execution is not None:
            row |= {name: getattr(execution, name) for name in _DRIVE}
            row |= {"outcome": execution.outcome.name, "failed": execution.outcome.is_failure}
        rows.append(row)
    notes = {"config": data.config.model_dump_json()}
    if DRIVER_SHA256 in data.notes:
        notes[WEIGHTS_NOTE] = data.notes[DRIVER_SHA256]
    schema = pa.schema({**_TEST, **_ROAD, **_DRIVE, **_OTHERS}, metadata=notes)
    with whole_file(path) as partial:
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), partial, compression="zstd")


def restore(table: Path, folder: Path) -> None:
    """Write the store of a campaign without gates from a table of docs/data; creates the folder if missing."""
    content = pq.read_table(table)
    notes = {key.decode(): value.decode() for key, value in content.schema.metadata.items()}
    config = json.loads(notes["config"])
    prepare_folder(folder)
    with closing(store_of(folder, parse_config(config, str(table), received=True))) as store:
        if WEIGHTS_NOTE in notes:
            store.note(DRIVER_SHA256, notes[WEIGHTS_NOTE])
        for row in content.to_pylist():
            road, conditions = road_from_json(json.loads(row["road"])), parse_conditions(row["conditions"])
            origin = Origin(row["sibling"], row["run"], row["number"])
            store.add_test(Test(row["test_id"], Scenario(road, conditions, seed=row["seed"]), origin))
            driven = {name: row[name] for name in ("test_id", "simulator", *_DRIVE)} | {"message": row["message"] or ""}
            store.add_execution(Execution(**driven, outcome=Outcome[row["outcome"]], drive=NO_DRIVE))


def read(table: Path) -> CampaignData:
    """Contents of a stored campaign."""
    with tempfile.TemporaryDirectory() as folder:
        restore(table, Path(folder) / "campaign")
        with closing(open_store(Path(folder) / "campaign")) as store:
            return read_campaign(store)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, help="table of docs/data")
    parser.add_argument("folder", type=Path, help="folder of the campaign, created if missing")
    arguments = parser.parse_args()
    restore(arguments.table, arguments.folder)
