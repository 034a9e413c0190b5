# SPDX-License-Identifier: Apache-2.0
"""Makes a campaign's folder again from its exported executions, to read it anywhere or to go on with it."""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ds_analysis.common.parquet import EXECUTIONS, FORMAT_VERSION, WEIGHTS_NOTE
from ds_base.folder_files import StoreError
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.folder import DRIVER_SHA256, prepare_folder, read_campaign, store_of
from ds_orchestrator.store.model import NO_DRIVE, Execution, Origin, Test
from ds_orchestrator.store.store import Store
from ds_road import road_from_json
from ds_sim.conditions.text import parse_conditions
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

LARGEST_TABLE = 2**30
"""Bytes of a table at most, as a file and in memory; chosen: a million executions take a third."""


def restore_campaign(table: Path, folder: Path) -> int:
    """Write a campaign's store from the `executions.parquet` that `write_tables` wrote; return its executions.

    Frames are not in that file: maps, statistics and predictions are as before, replays and profiles are empty. The
    campaign can be resumed: its search replays from the outcomes.

    Args:
        table: file, possibly received from a third party.
        folder: campaign folder, created if missing; it must not hold a campaign.

    Raises:
        StoreError: the file is not such a table, or holds what no campaign can have; nothing is left in the folder.
    """
    if (folder / "campaign.sqlite").exists():
        raise StoreError(f"{folder} holds a campaign: choose another --out")
    rows, notes = _read(table)
    new = not folder.exists()
    prepare_folder(folder)
    try:
        config = parse_config(json.loads(notes["config"]), str(table), received=True)
        with closing(store_of(folder, config)) as store:
            if WEIGHTS_NOTE in notes:
                store.note(DRIVER_SHA256, notes[WEIGHTS_NOTE])
            for row in rows:
                _add(store, row)
        with closing(store_of(folder, config)) as store:
            return len(read_campaign(store).executions)  # checks every row as it checks a received store's
    except (ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
        (folder / "campaign.sqlite").unlink(missing_ok=True)
        if new:
            shutil.rmtree(folder)
        what = str(error).replace(f"{folder / 'campaign.sqlite'}", "it").splitlines()[0][:200] if str(error) else ""
        raise StoreError(f"{table} holds no campaign: {what or type(error).__name__}") from None


def _read(table: Path) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Rows and notes of an exported table."""
    expected = "expected the executions.parquet of `ds campaign export`"
    try:
        with pq.ParquetFile(table) as file:
            size = sum(file.metadata.row_group(k).total_byte_size for k in range(file.metadata.num_row_groups))
            if max(size, table.stat().st_size) > LARGEST_TABLE:
                raise StoreError(f"{table} has more than {LARGEST_TABLE // 2**30} GiB: restore a smaller campaign")
            raw = file.schema_arrow.metadata or {}
            notes = {key.decode(): value.decode() for key, value in raw.items()}
            missing = {column.name for column in EXECUTIONS} - set(file.schema_arrow.names)
            if missing or notes.get("format_version") != FORMAT_VERSION or "config" not in notes:
                raise StoreError(f"{table} has other columns or another version: {expected}")
            return file.read().to_pylist(), notes
    except (OSError, pa.ArrowException, UnicodeDecodeError):
        raise StoreError(f"{table} cannot be read: {expected}") from None


def _add(store: Store, row: dict[str, Any]) -> None:
    if row["gate"] is not None:
        raise ValueError("its tests passed gates, whose measurements are not in the table")
    road, conditions = road_from_json(json.loads(row["road"])), parse_conditions(row["conditions"])
    origin = Origin(row["sibling"], row["run"], row["number"])
    store.add_test(Test(row["test_id"], Scenario(road, conditions, seed=row["seed"]), origin))
    store.add_execution(
        Execution(
            test_id=row["test_id"], simulator=row["simulator"], outcome=Outcome[row["outcome"]],
            message=row["message"] or "", fitness=row["fitness"], max_lateral_position=row["max_lateral_position"],
            steps=row["steps"], simulated_seconds=row["simulated_seconds"],
            trajectory_sha256=row["trajectory_sha256"], drive=NO_DRIVE,
        )
    )  # fmt: skip
