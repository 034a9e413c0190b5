"""Lists campaigns below a folder, without reading their trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.folder import config_of, open_store
from ds_orchestrator.campaign.provenance import DRIVER_SHA256
from ds_orchestrator.store.folder_files import is_locked
from ds_orchestrator.store.sqlite_file import StoreError
from ds_sim.simulator import Outcome

DEEPEST = 3
"""Levels of folders that are looked into; chosen: deep enough for a folder of campaigns, quick in a home folder."""


@dataclass(frozen=True, kw_only=True)
class CampaignRow:
    """One campaign of a list.

    Attributes:
        folder: campaign folder.
        driver: name of the driver; "" if the campaign cannot be read.
        sha256: digest of the driver's files, or "".
        changed: time of the last drive, ISO 8601, UTC.
        state: `done`, `running`, `stopped`, or why it cannot be read.
        drives: number of drives with a verdict.
        drives_at_most: their number at the end.
        failures: simulator -> failures and drives.
    """

    folder: Path
    driver: str
    sha256: str
    changed: str
    state: str
    drives: int
    drives_at_most: int
    failures: dict[str, tuple[int, int]]


def campaigns_below(folder: Path) -> Iterator[CampaignRow]:
    """Find campaigns, by path; a damaged one is in the list, with the reason."""
    for path in sorted(_stores(folder, DEEPEST)):
        yield _row(path.parent)


def _stores(folder: Path, depth: int) -> Iterator[Path]:
    try:
        if (folder / "campaign.sqlite").is_file():
            yield folder / "campaign.sqlite"
            return
        inside = [entry for entry in folder.iterdir() if entry.is_dir() and not entry.is_symlink()] if depth else []
    except OSError:  # a folder of somebody else's
        return
    for entry in inside:
        if not entry.name.startswith("."):
            yield from _stores(entry, depth - 1)


def _row(folder: Path) -> CampaignRow:
    changed = max(path.lstat().st_mtime for path in folder.glob("campaign.sqlite*"))
    written = datetime.fromtimestamp(changed, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    try:
        with closing(open_store(folder)) as store:
            config, counts = config_of(store), store.outcome_counts()
            excluded = sum(not gate.is_valid for gate in store.gates().values())
            made, current = store.results().get("report"), store.count_results()
            sha256 = store.notes().get(DRIVER_SHA256, "")
    except (StoreError, ConfigError, OSError) as error:
        return CampaignRow(
            folder=folder, driver="", sha256="", changed=written, state=str(error), drives=0, drives_at_most=0,
            failures={},
        )  # fmt: skip
    tally = dict.fromkeys(config.simulators, (0, 0))
    for (simulator, outcome), number in counts.items():
        failures, drives = tally[simulator]
        tally[simulator] = failures + number * Outcome[outcome].is_failure, drives + number
    drives = sum(counts.values())
    complete = config.elites_only or drives + excluded >= config.executions_at_most
    state = "running" if is_locked(folder) else "done" if complete and made == current else "stopped"
    return CampaignRow(
        folder=folder,
        driver=config.driver,
        sha256=sha256,
        changed=written,
        state=state,
        drives=drives,
        drives_at_most=config.executions_at_most,
        failures=tally,
    )
