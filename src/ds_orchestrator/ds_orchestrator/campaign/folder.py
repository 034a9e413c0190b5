"""Campaign folder: lock, contents and store."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

from ds_driver.whole_files import write_whole
from ds_orchestrator.campaign.config import MOST_WORKERS, CampaignConfig, ConfigError, Engine, parse_config
from ds_orchestrator.store.sqlite_file import StoreError
from ds_orchestrator.store.store import Store


class LockError(RuntimeError):
    """Campaign folder that another process uses, or that cannot be written."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder; the kernel releases the lock when this process ends.

    Raises:
        LockError: another process holds the lock, or the folder cannot be written.
    """
    try:
        file = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise LockError(
            f"{folder} cannot be written ({error.strerror}): check its permissions and disk, or choose another --out"
        ) from None
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LockError(f"{folder} is in use by another run: wait for it, or choose another --out") from None
        except OSError as error:
            raise LockError(f"{folder} cannot be locked ({error.strerror}): choose an --out on a local disk") from None
        yield
    finally:
        os.close(file)


STAGES = ("maps", "evaluation", "report")
"""Stages that compute results from the executions, in order."""
LIVE = ".live.json"
"""File that says what a running campaign does; see `ds_orchestrator.campaign.live_file`."""
ENGINE = ".engine.json"
"""File with what drove last: engine and workers, which belong to no result and so not to the store."""
_ENGINE_BYTES = 1000
WRITTEN = ("bags", "logs", "maps", "evaluation", "refinement", "report.html")
"""Entries that a campaign writes into its folder beside the store."""


def open_store(folder: Path, *, read_only: bool = False) -> Store:
    """Open the store of an existing campaign.

    Args:
        folder: campaign folder.
        read_only: change nothing, even while the campaign runs.

    Raises:
        StoreError: the folder holds no campaign.
    """
    if not folder.is_dir():
        raise StoreError(f"no folder {folder}: run a campaign there first")
    return Store(folder / "campaign.sqlite", read_only=read_only)


def prepare_folder(folder: Path) -> None:
    """Create a campaign folder if it is missing, and check that nothing else would be overwritten.

    Raises:
        StoreError: it cannot be created, or holds files that a campaign would overwrite.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise StoreError(f"{folder} is a file, expected a folder: choose another --out") from None
    except OSError as error:
        raise StoreError(f"{folder} cannot be created ({error.strerror}): choose another --out") from None
    foreign = [name for name in WRITTEN if (folder / name).exists()]
    if foreign and not (folder / "campaign.sqlite").exists():
        raise StoreError(f"{folder} holds {foreign[0]} but no campaign: choose another --out, or remove {foreign[0]}")
    refuse_foreign_files(folder)


def refuse_foreign_files(folder: Path) -> None:
    """Refuse a folder in which a write would leave the folder through a link, or block on a FIFO.

    Raises:
        StoreError: an entry is a link that leaves the folder, or is neither a file nor a folder.
    """
    home = folder.resolve()
    places = [folder / name for name in ("campaign.sqlite", ".lock", ENGINE, LIVE, f"{LIVE}.partial", *WRITTEN)]
    inside = [entry for place in places if place.is_dir() for entry in place.iterdir()]
    for path in (*places, *inside):
        if path.is_symlink() and not path.resolve().is_relative_to(home):
            raise StoreError(f"{path} is a link to {path.resolve()}, outside the campaign's folder: remove it")
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise StoreError(f"{path} is neither a file nor a folder: remove it")


def store_of(folder: Path, config: CampaignConfig) -> Store:
    """Open the store of a campaign that starts or resumes with a configuration.

    Keys that an earlier version wrote are rewritten with their present names.

    Raises:
        StoreError: the folder holds a campaign with another configuration, or cannot be used.
    """
    store = Store(
        folder / "campaign.sqlite", config=config.identity(), present=_with_present_keys, conditions=config.has_gates
    )
    try:
        _check(store, config)
    except StoreError:
        store.close()
        raise
    return store


def _with_present_keys(identity: str) -> str:
    try:
        return _parsed(identity).identity()
    except ConfigError:
        return identity  # differs from every valid one; the store reports the differences


def keep_engine(folder: Path, config: CampaignConfig) -> None:
    """Write what drives a campaign, so that it resumes in the same way."""
    write_whole(folder / ENGINE, json.dumps({"engine": config.engine, "workers": config.workers}).encode())


def with_kept_engine(folder: Path, config: CampaignConfig) -> CampaignConfig:
    """Let a campaign be driven by what drove it last; unchanged if that is not known."""
    try:
        with (folder / ENGINE).open("rb") as file:
            kept = json.loads(file.read(_ENGINE_BYTES))
        engine, workers = kept["engine"], kept["workers"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return config
    if engine not in get_args(Engine) or type(workers) is not int or not 1 <= workers <= MOST_WORKERS:
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
    return parse_config(raw, source)
