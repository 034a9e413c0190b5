"""The folder of a campaign: who may use it, what lies in it, and its store."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.store.store import Store, StoreError


class LockError(RuntimeError):
    """A folder that another process uses."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder; the kernel lets go of it when this process ends.

    Raises:
        LockError: another process holds it, or nothing can be written there.
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
        except OSError:
            raise LockError(f"{folder} is in use by another run: wait for it, or choose another --out") from None
        yield
    finally:
        os.close(file)


STAGES = ("maps", "evaluation", "report")
"""What is made of the executions, in order."""


WRITTEN = ("bags", "logs", "maps", "evaluation", "report.html")
"""What a campaign writes into its folder beside the store."""


def open_store(folder: Path) -> Store:
    """The store of a campaign that was run already.

    Raises:
        StoreError: there is none.
    """
    if not folder.is_dir():
        raise StoreError(f"no folder {folder}: run a campaign there first")
    return Store(folder / "campaign.sqlite")


def prepare_folder(folder: Path) -> None:
    """Make a folder for a campaign if need be, and see that nobody else's files lie where it writes.

    Raises:
        StoreError: it cannot be made, or would be written over.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise StoreError(f"{folder} is a file, expected a folder: choose another --out") from None
    except OSError as error:
        raise StoreError(f"{folder} cannot be made ({error.strerror}): choose another --out") from None
    foreign = [name for name in WRITTEN if (folder / name).exists()]
    if foreign and not (folder / "campaign.sqlite").exists():
        raise StoreError(f"{folder} holds {foreign[0]} and no campaign, it would be written over: choose another --out")


def store_of(folder: Path, config: CampaignConfig) -> Store:
    """The store of a campaign that begins or goes on with this configuration.

    A configuration that an earlier version wrote is rewritten with the present names of its keys.

    Raises:
        StoreError: the folder holds a campaign with another configuration, or cannot be used.
    """
    return Store(folder / "campaign.sqlite", config=config.identity(), present=_with_present_keys)


def _with_present_keys(identity: str) -> str:
    return parse_config(json.loads(identity), "campaign.sqlite").identity()


def config_of(store: Store) -> CampaignConfig:
    """The configuration as run."""
    return parse_config(json.loads(store.config), "campaign.sqlite")
