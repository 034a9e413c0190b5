# SPDX-License-Identifier: Apache-2.0
"""Writes every frame of a campaign's drives as a Parquet file, with units and descriptions of the columns."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ds_base.folder_files import whole_file
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.store.model import Execution
from ds_sim.simulator import FRAME_TIME

FILE = "frames.parquet"
_CATEGORY = pa.dictionary(pa.int32(), pa.string())
COLUMNS: dict[str, tuple[pa.DataType, str, str]] = {
    "test_id": (_CATEGORY, "", "test: sibling, search run and number"),
    "simulator": (_CATEGORY, "", "simulator that drove the test"),
    "step": (pa.int32(), "", "frame, from 0 at rest"),
    "time": (pa.float64(), "s", "simulated time"),
    "x": (pa.float64(), "m", "position in the road frame"),
    "y": (pa.float64(), "m", "position in the road frame"),
    "yaw": (pa.float64(), "rad", "heading, counter-clockwise from x"),
    "speed": (pa.float64(), "m/s", "velocity along the heading"),
    "lateral_position": (pa.float64(), "m", "distance from the lane's centre line, right positive"),
    "steering": (pa.float64(), "", "command to the next frame, -1 full left to 1 full right; null at the end"),
}
"""Column -> type, SI unit or "", and meaning."""
_SCHEMA = pa.schema(
    [
        pa.field(name, kind, metadata={"unit": unit, "description": meaning})
        for name, (kind, unit, meaning) in COLUMNS.items()
    ]
)
_ROWS = 100_000
"""Rows written at once; chosen: 10 MB."""


def write_frames(folder: Path, data: CampaignData) -> Path:
    """Write a row for each frame of each execution of a campaign, finished or not; return the file's path."""
    with whole_file(folder / FILE) as partial, pq.ParquetWriter(partial, _SCHEMA, compression="zstd") as writer:
        for batch in _batches(data):
            writer.write_table(pa.concat_tables(map(_table, batch)).unify_dictionaries())
    return folder / FILE


def _batches(data: CampaignData) -> Iterator[list[Execution]]:
    """Executions, so many together that they have some `_ROWS` rows."""
    batch: list[Execution] = []
    for one in data.executions:
        batch.append(one)
        if sum(len(member.trajectory) for member in batch) >= _ROWS:
            yield batch
            batch = []
    if batch:
        yield batch


def _table(one: Execution) -> pa.Table:
    count = len(one.trajectory)
    steering = np.full(count, np.nan)
    steering[: len(one.steering)] = one.steering[:count]
    step = np.arange(count, dtype=np.int32)
    names = [pa.array([name] * count, pa.string()).dictionary_encode() for name in (one.test_id, one.simulator)]
    # NaN stands for no value: no stored number is one.
    columns = [*names, step, step * FRAME_TIME, *one.trajectory.T, pa.array(steering, from_pandas=True)]
    return pa.table(columns, schema=_SCHEMA)
