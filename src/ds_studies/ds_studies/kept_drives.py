"""Drives roads in worker processes and keeps each run in a file, so that a stopped comparison goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path

from ds_driver.closed_loop.drive_request import AUTOPILOT, DriveRequest
from ds_driver.closed_loop.simulation import drive_all, run_drive
from ds_driver.networks.network_driver import driver_sha256
from ds_driver.process_pool import map_in_processes
from ds_driver.whole_files import write_json, write_whole
from ds_orchestrator.engines.fingerprint import code_sha256
from ds_orchestrator.store.folder_files import make_folder, read_file
from ds_orchestrator.store.sqlite_file import StoreError
from ds_sim.conditions.text import format_conditions
from ds_sim.registry import label_of, spec_of
from ds_sim.run_codec import RunCodecError, decode_run, encode_run
from ds_sim.session import RunRecord

SETTINGS = "settings.json"
LARGEST_RUN = 64 * 2**20
"""Bytes; chosen: a run of a million frames fits."""


class KeptDrivesError(ValueError):
    """A folder that holds the drives of another driver or car."""


def drive_kept(
    drives: Sequence[DriveRequest], folder: Path | None, *, workers: int | None = None, say: Callable[[str], None]
) -> Iterator[tuple[RunRecord, bool]]:
    """Drive all roads, except for those whose runs a folder holds.

    A run is written as soon as it has a verdict; one that ended in an error is driven again the next time.

    Args:
        drives: what to drive, all with the same driver.
        folder: of the kept runs, created if missing; None to keep nothing.
        workers: number of processes; the number of available processors if None.
        say: called with one line if the code has changed since the folder began.

    Yields:
        Each run, in order, and whether it was driven now.

    Raises:
        KeptDrivesError: the folder's runs are those of another driver, or of another car.
    """
    if folder is None:
        yield from ((run, True) for run in drive_all(drives, workers=workers))
        return
    check_settings(folder, drives[0].driver, {drive.simulator for drive in drives}, say)
    kept = [read_kept(folder, drive) for drive in drives]
    missing = [drive for drive, run in zip(drives, kept, strict=True) if run is None]
    fresh = map_in_processes(partial(_drive_and_keep, folder), missing, workers=workers) if missing else iter(())
    for run in kept:
        yield (next(fresh), True) if run is None else (run, False)


def check_settings(folder: Path, driver: str, names: Collection[str], say: Callable[[str], None]) -> None:
    """Write what the runs depend on besides road, seed and conditions, or compare it with what the folder began with.

    Args:
        folder: of the kept runs, created if missing.
        driver: name of the driver.
        names: names of the simulators.
        say: called with one line if the code has changed since the folder began.

    Raises:
        KeptDrivesError: the folder's runs are those of another driver, or of another car.
    """
    cars = {name: str(spec_of(name).extra.get("car", "")) for name in names if "@" in name}
    sha256 = "" if driver == AUTOPILOT else driver_sha256(driver)
    now = {"driver": driver, "sha256": sha256, "cars": cars, "code": code_sha256()}
    make_folder(folder)
    path = folder / SETTINGS
    try:
        began = json.loads(read_file(folder, SETTINGS))
        known = {key: began[key] for key in now}
        known_cars = dict(known["cars"])
    except FileNotFoundError:
        write_json(path, now)
        return
    except StoreError:
        raise
    except (ValueError, KeyError, TypeError, RecursionError):
        raise KeptDrivesError(f"{path} cannot be read: remove {folder}, or choose another --out") from None
    if known["driver"] != driver:
        raise KeptDrivesError(
            f"{folder} holds drives of {known['driver']!s:.60}, not of {driver}: choose another --out"
        )
    if known["sha256"] != sha256:
        raise KeptDrivesError(f"the weights of {driver} have changed since {folder} began: choose another --out")
    for name, car in cars.items():
        if known_cars.get(name, car) != car:
            raise KeptDrivesError(f"{name}: the file has changed since {folder} began: choose another --out")
    if known["code"] != now["code"]:
        say(f"the code has changed since {folder} began: its drives are kept; choose another --out to drive them again")


def _drive_and_keep(folder: Path, drive: DriveRequest) -> RunRecord:
    """Drive in a worker process, which writes the run, so that it is kept whatever happens to the others."""
    run = run_drive(drive)
    if run.outcome.is_verdict:
        keep(folder, drive, run)
    return run


def keep(folder: Path, drive: DriveRequest, run: RunRecord) -> None:
    """Write the run of a drive to a folder."""
    write_whole(folder / _name(drive), encode_run(run))


def read_kept(folder: Path, drive: DriveRequest) -> RunRecord | None:
    """Read the run of a drive from a folder; None if it is not there or damaged."""
    try:
        return decode_run(read_file(folder, _name(drive), LARGEST_RUN), drive.road, drive.seed, drive.conditions)
    except (FileNotFoundError, RunCodecError):
        return None  # not driven yet, or a damaged file: drive


def _name(drive: DriveRequest) -> str:
    conditions = format_conditions(drive.conditions)
    digest = f"-{hashlib.sha256(conditions.encode()).hexdigest()[:16]}" if conditions else ""
    return f"{_label(drive.simulator)}/{drive.road.road_id}-{drive.seed}{digest}.run"


def _label(simulator: str) -> str:
    """Label of a simulator; of one with a parameter file, by the file's content, so that the folder may be moved."""
    name, at, _ = simulator.partition("@")
    return label_of(f"{name}@{spec_of(simulator).extra.get('car', simulator)}" if at else simulator)
