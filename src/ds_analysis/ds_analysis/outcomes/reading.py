# SPDX-License-Identifier: Apache-2.0
"""Reads the outcomes of any folder: of a campaign, of a comparison of siblings, or of a study."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from ds_analysis.common.outcome_table import (
    SIBLINGS,
    OutcomeTable,
    OutcomeTableError,
    RoadTable,
    is_study,
    siblings_file,
    table_of_campaign,
    table_of_comparison,
)
from ds_orchestrator.campaign.folder import open_store, read_campaign
from ds_sim.registry import SimulatorName


def read_table(folder: Path, *, twin: SimulatorName | None = None, most: int | None = None) -> OutcomeTable:
    """Read a folder of `ds campaign run`, finished or running, of `ds siblings compare --out`, or `ds outcomes import`.

    The twin is the campaign's own if None; for `most` see `table_of_campaign`.

    Raises:
        OutcomeTableError: the folder holds neither, or has no such simulator, or no verdict yet.
        ds_orchestrator.store.sqlite_file.StoreError: the campaign's file is damaged.
        ds_orchestrator.campaign.config.ConfigError: its configuration is not valid.
    """
    if (folder / "campaign.sqlite").exists() or (folder / siblings_file(folder)).exists() or not is_study(folder):
        return read_road_table(folder, twin=twin, most=most)
    from ds_analysis.outcomes.study import read_study

    table = read_study(folder).table()
    return table.with_twin(twin) if twin else table


def read_road_table(folder: Path, *, twin: SimulatorName | None = None, most: int | None = None) -> RoadTable:
    """Read a folder of `ds campaign run` or `ds siblings compare --out`; see `read_table`."""
    if (folder / "campaign.sqlite").exists():
        with closing(open_store(folder)) as store:
            table = table_of_campaign(read_campaign(store), most=most)
        return table.with_twin(twin) if twin else table
    if (folder / siblings_file(folder)).exists():
        return table_of_comparison(folder, twin=twin)
    raise OutcomeTableError(
        f"{folder} holds no campaign.sqlite, {SIBLINGS} or outcomes.parquet: expected a folder of `ds campaign "
        "run`, `ds siblings compare --out` or `ds outcomes import`"
    )
