# SPDX-License-Identifier: Apache-2.0
"""What runs on a Dask worker: prepares itself for a campaign, and drives with the engine `local`, without ROS."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ds_driver.closed_loop.drive_request import request_from_json
from ds_orchestrator.engines.fingerprint import fingerprint
from ds_orchestrator.engines.local import LocalEngine, running_local
from ds_orchestrator.engines.parcel import Parcel
from ds_sim.registry import SimulatorName
from ds_sim.run_codec import encode_run

Key = tuple[str, float]
"""Digest of a parcel, and wall-clock time for one answer of the driver, s."""


@dataclass(frozen=True)
class _Prepared:
    """Parcel on this worker, its folder, and the engine that drives with it until `stack` is closed."""

    parcel: Parcel
    folder: Path
    engine: LocalEngine
    stack: ExitStack


_lock = threading.Lock()
_prepared: dict[Key, _Prepared] = {}


def describe_worker(key: Key, backend: str, simulators: tuple[SimulatorName, ...]) -> tuple[dict[str, str], int]:
    """Describe this worker: its fingerprint, and the drives that it takes at a time; 0 if it is not prepared."""
    with _lock:
        return fingerprint(backend, simulators), _prepared[key].engine.capacity if key in _prepared else 0


def unpack_parcel(key: Key, parcel: Parcel) -> int:
    """Unpack a parcel, and start one process per thread of this worker; idle ones of other campaigns end.

    Returns the number of drives at a time.
    """
    from distributed import get_worker

    worker = get_worker()
    folder = Path(worker.local_directory) / "digital_siblings" / key[0][:16]
    with _lock:
        for other in [other for other, one in _prepared.items() if not one.engine.drives]:
            _prepared.pop(other).stack.close()
    parcel.unpack(folder)
    _check(parcel, folder)
    driver = parcel.driver_there(parcel.driver, folder)
    with ExitStack() as stack:
        engine = stack.enter_context(
            running_local(driver, workers=worker.state.nthreads, command_timeout=key[1], logs=folder)
        )
        with _lock:
            _prepared[key] = _Prepared(parcel, folder, engine, stack.pop_all())
    return engine.capacity


def drive(key: Key, request: dict[str, Any]) -> bytes | None:
    """Drive a road, asked for as JSON value with names as where the campaign runs.

    Returns the run, encoded by `ds_sim.run_codec`; None if this worker is not prepared for it any more.
    """
    from distributed import secede

    secede()  # type: ignore[no-untyped-call]  # a process takes several drives at a time, a thread of the worker one
    with _lock:
        one = _prepared.get(key)
    if one is None:
        return None
    asked = request_from_json(request)
    simulator = one.parcel.simulator_there(asked.simulator, one.folder)
    driver = one.parcel.driver_there(asked.driver, one.folder)
    run = one.engine.drive(replace(asked, simulator=simulator, driver=driver))
    with _lock:
        return encode_run(run) if _prepared.get(key) is one else None


def _check(parcel: Parcel, folder: Path) -> None:
    """Raise ValueError unless the driver here is the driver there, and every simulator can be made."""
    from ds_driver.networks.network_driver import driver_sha256
    from ds_sim.registry import make_simulator

    driver = parcel.driver_there(parcel.driver, folder)
    if parcel.driver_sha256 and driver_sha256(driver) != parcel.driver_sha256:
        raise ValueError(f"driver {parcel.driver} has other content there")
    for simulator in parcel.simulators:
        make_simulator(parcel.simulator_there(simulator, folder)).close()
