"""Reads the tests of a folder: a campaign, or a comparison of siblings."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from ds_analysis.prediction.outcome_table import (
    OutcomeTable,
    OutcomeTableError,
    table_of_campaign,
    table_of_comparison,
)
from ds_orchestrator.search.features import DEFAULT_FEATURES


@dataclass(frozen=True, kw_only=True)
class Source:
    """Tests of a folder.

    Attributes:
        table: tests, features and outcomes.
        features: names of the axes of its feature map.
    """

    table: OutcomeTable
    features: tuple[str, ...]


def read_source(folder: Path, *, twin: str | None = None) -> Source:
    """Read a folder of `ds campaign run`, finished or running, or of `ds siblings compare --out`.

    Args:
        folder: the folder.
        twin: simulator that plays the twin; the campaign's own twin if None.

    Raises:
        OutcomeTableError: the folder holds neither, or has no such simulator, or no verdict yet.
        ds_orchestrator.store.sqlite_file.StoreError: the campaign's file is damaged.
        ds_orchestrator.campaign.config.ConfigError: its configuration is not valid.
    """
    if (folder / "campaign.sqlite").exists():
        from ds_orchestrator.campaign.folder import open_store, read_campaign

        with closing(open_store(folder)) as store:
            data = read_campaign(store)
        table = table_of_campaign(data)
        return Source(table=table.with_twin(twin) if twin else table, features=tuple(data.config.features))
    if (folder / "comparison.json").exists():
        return Source(table=table_of_comparison(folder, twin=twin), features=DEFAULT_FEATURES)
    raise OutcomeTableError(
        f"{folder} holds no campaign.sqlite and no comparison.json: expected a folder of `ds campaign run` or of "
        "`ds siblings compare --out`"
    )


def read_population(folder: Path) -> Source:
    """Read a folder for the prediction of a car: all its simulators are siblings, a digital twin among them.

    Raises:
        OutcomeTableError: as `read_source`.
    """
    source = read_source(folder)
    return Source(table=as_population(source.table), features=source.features)


def as_population(table: OutcomeTable) -> OutcomeTable:
    """Let a twin that was driven be one more sibling; one that was not is left out."""
    if table.twin is None or not table.known(table.twin).any():
        return table.with_twin(None)
    return replace(table, siblings=table.simulators, twin=None)
