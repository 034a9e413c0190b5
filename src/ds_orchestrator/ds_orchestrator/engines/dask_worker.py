# SPDX-License-Identifier: Apache-2.0
"""What runs on a Dask worker: prepares itself for a campaign, and drives in child processes, without ROS."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ds_driver.closed_loop.drive_request import request_from_json
from ds_driver.closed_loop.worker_process import WorkerProcess
from ds_orchestrator.engines.fingerprint import fingerprint
from ds_orchestrator.engines.parcel import Parcel
from ds_sim.run_codec import encode_run


@dataclass(frozen=True)
class _Unpacked:
    """Parcel on this worker, its folder, and the number of drives that a process with its driver takes at a time."""

    parcel: Parcel
    folder: Path
    largest_batch: int = 1


_lock = threading.Lock()
_parcels: dict[str, _Unpacked] = {}
_idle: list[tuple[str, WorkerProcess]] = []


def describe(sha256: str, backend: str, simulators: tuple[str, ...]) -> dict[str, Any]:
    """Describe this worker.

    Returns:
        `fingerprint`, and `largest_batch` if it has prepared itself for the parcel; or `error`, one line.
    """
    try:
        found: dict[str, Any] = {"fingerprint": fingerprint(backend, simulators)}
    except Exception as error:  # an exception may not survive the way back
        return {"error": _one_line(error)}
    if sha256 in _parcels:
        found["largest_batch"] = _parcels[sha256].largest_batch
    return found


def prepare(parcel: Parcel, command_timeout: float) -> dict[str, Any]:
    """Unpack a parcel, and start one process with its driver.

    Returns:
        `largest_batch`, the number of drives that one process takes at a time, or `error`, one line.
    """
    from distributed import get_worker

    sha256 = parcel.sha256
    folder = Path(get_worker().local_directory) / "digital_siblings" / sha256[:16]
    try:
        parcel.unpack(folder)
        _check(parcel, folder)
        process = _taken(_Unpacked(parcel, folder), command_timeout)
        batch = process.start()
    except Exception as error:
        return {"error": _one_line(error)}
    _parcels[sha256] = _Unpacked(parcel, folder, batch)
    _give_back(sha256, command_timeout, process)
    return {"largest_batch": batch}


def drive(sha256: str, command_timeout: float, drives: list[dict[str, Any]]) -> list[bytes] | None:
    """Drive a batch of roads in one process.

    Args:
        sha256: digest of the parcel.
        command_timeout: wall-clock time for one answer of the driver, s.
        drives: requests as JSON values, with names as where the campaign runs.

    Returns:
        The runs, encoded by `ds_sim.run_codec`, in order; None if this worker does not have the parcel.
    """
    if sha256 not in _parcels:
        return None
    unpacked = _parcels[sha256]
    process = _taken(unpacked, command_timeout)

    def run(one: dict[str, Any]) -> bytes:
        request = request_from_json(one)
        simulator, driver = (
            unpacked.parcel.name_there(name, unpacked.folder) for name in (request.simulator, request.driver)
        )
        return encode_run(process.drive(replace(request, simulator=simulator, driver=driver)))

    try:
        with ThreadPoolExecutor(len(drives)) as pool:
            return list(pool.map(run, drives))
    finally:
        _give_back(sha256, command_timeout, process)


def _check(parcel: Parcel, folder: Path) -> None:
    """Check that the driver here is the driver there, and that every simulator can be made.

    Raises:
        ValueError: it is not, or one cannot.
    """
    from ds_driver.networks.network_driver import driver_sha256
    from ds_sim.registry import make_simulator

    driver = parcel.name_there(parcel.driver, folder)
    if parcel.driver_sha256 and driver_sha256(driver) != parcel.driver_sha256:
        raise ValueError(f"driver {parcel.driver} has other content there")
    for simulator in parcel.simulators:
        make_simulator(parcel.name_there(simulator, folder)).close()


def _taken(unpacked: _Unpacked, command_timeout: float) -> WorkerProcess:
    """Take an idle process with this parcel's driver, or make one; idle ones of other campaigns end."""
    parcel, folder = unpacked.parcel, unpacked.folder
    key = _key(parcel.sha256, command_timeout)
    with _lock:
        others = [pair for pair in _idle if pair[0] != key]
        own = [pair for pair in _idle if pair[0] == key]
        _idle[:] = own[1:]
    for _, process in others:
        process.close()
    if own:
        return own[0][1]
    log = folder / "worker.log"
    return WorkerProcess(parcel.name_there(parcel.driver, folder), command_timeout=command_timeout, log=log)


def _give_back(sha256: str, command_timeout: float, process: WorkerProcess) -> None:
    with _lock:
        _idle.append((_key(sha256, command_timeout), process))


def _key(sha256: str, command_timeout: float) -> str:
    return f"{sha256} {command_timeout}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
