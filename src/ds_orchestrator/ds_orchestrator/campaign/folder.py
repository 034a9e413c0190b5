"""Campaign folder: contents and store."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

from ds_driver.whole_files import write_whole
from ds_orchestrator.campaign.config import MOST_WORKERS, CampaignConfig, ConfigError, parse_config
from ds_orchestrator.campaign.drive_settings import EngineName
from ds_orchestrator.store.folder_files import check_name, make_folder, read_file
from ds_orchestrator.store.sqlite_file import StoreError
from ds_orchestrator.store.store import Store

STAGES = ("maps", "evaluation", "report")
"""Stages that compute results from the executions, in order."""
LIVE = ".live.json"
"""File that says what a running campaign does; see `ds_orchestrator.campaign.live_file`."""
ENGINE = ".engine.json"
"""File with what drove last: engine and workers, which belong to no result and so not to the store."""
_ENGINE_BYTES = 1000
WRITTEN = ("bags", "logs", "maps", "evaluation", "report.html")
"""Entries that a campaign writes into its folder beside the store."""


def open_store(folder: Path, *, writable: bool = False) -> Store:
    """Open the store of an existing campaign.

    Args:
        folder: campaign folder.
        writable: results may be written, under `ds_orchestrator.store.folder_files.locked`; without, nothing in the
            folder changes, and everything that is read is of one moment, even while the campaign runs.

    Raises:
        StoreError: the folder holds no campaign.
    """
    check_name(folder)
    if not folder.is_dir():
        raise StoreError(f"no folder {folder}: run a campaign there first")
    return Store(folder / "campaign.sqlite", read_only=not writable)


def prepare_folder(folder: Path) -> None:
    """Create a campaign folder if it is missing, and check that nothing else would be overwritten.

    Raises:
        StoreError: it cannot be created, or holds files that a campaign would overwrite.
    """
    make_folder(folder)
    foreign = [name for name in WRITTEN if (folder / name).exists()]
    if foreign and not (folder / "campaign.sqlite").exists():
        raise StoreError(f"{folder} holds {foreign[0]} but no campaign: choose another --out, or remove {foreign[0]}")


def store_of(folder: Path, config: CampaignConfig) -> Store:
    """Open the store of a campaign that starts or resumes with a configuration.

    Raises:
        StoreError: the folder holds a campaign with another configuration, or cannot be used.
    """
    store = Store(folder / "campaign.sqlite", config=config.identity())
    try:
        _check(store, config)
    except StoreError:
        store.close()
        raise
    return store


def keep_engine(folder: Path, config: CampaignConfig) -> None:
    """Write what drives a campaign, so that it resumes in the same way."""
    write_whole(folder / ENGINE, json.dumps({"engine": config.engine, "workers": config.workers}).encode())


def with_kept_engine(folder: Path, config: CampaignConfig) -> CampaignConfig:
    """Let a campaign be driven by what drove it last; unchanged if that is not known."""
    try:
        kept = json.loads(read_file(folder, ENGINE, _ENGINE_BYTES))
        engine, workers = kept["engine"], kept["workers"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return config
    if engine not in get_args(EngineName) or type(workers) is not int or not 1 <= workers <= MOST_WORKERS:
        return config
    return config.model_copy(update={"engine": engine, "workers": workers})


def config_of(store: Store) -> CampaignConfig:
    """Read the configuration of a stored campaign, and check the store's names against it.

    Raises:
        ConfigError: the stored configuration is not valid.
        StoreError: the store has tests or executions that this campaign cannot have.
    """
    config = _parsed(store.config)
    _check(store, config)
    return config


def _check(store: Store, config: CampaignConfig) -> None:
    store.check(config.siblings, config.simulators, runs=config.search.runs, budget=config.settings.budget)


def _parsed(text: str) -> CampaignConfig:
    source = "the configuration in campaign.sqlite"
    try:
        raw = json.loads(text)
    except (ValueError, RecursionError):
        raise ConfigError(f"{source} is not JSON: restore the file from a copy") from None
    return parse_config(raw, source, received=True)
