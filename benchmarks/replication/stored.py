# SPDX-License-Identifier: Apache-2.0
"""Makes a campaign's folder again from a table in docs/data, to compute its numbers or to go on with it.

`python -m benchmarks.replication.stored docs/data/replication/dave2.parquet FOLDER`; then `ds evaluate FOLDER`. Frames
are not in the tables: maps, statistics and predictions are as before, replays are empty.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from contextlib import closing
from pathlib import Path

import pyarrow.parquet as pq

from ds_analysis.common.parquet import WEIGHTS_NOTE
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
from ds_road import road_from_json
from ds_sim.conditions.text import parse_conditions
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome


def restore(table: Path, folder: Path) -> None:
    """Write the store of a campaign without gates from the `executions.parquet` that `write_tables` wrote.

    Args:
        table: one of docs/data.
        folder: campaign folder, created if missing.
    """
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
            execution = Execution(
                test_id=row["test_id"],
                simulator=row["simulator"],
                outcome=Outcome[row["outcome"]],
                message=row["message"] or "",
                fitness=row["fitness"],
                max_lateral_position=row["max_lateral_position"],
                steps=row["steps"],
                simulated_seconds=row["simulated_seconds"],
                trajectory_sha256=row["trajectory_sha256"],
                drive=NO_DRIVE,
            )
            store.add_execution(execution)


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
