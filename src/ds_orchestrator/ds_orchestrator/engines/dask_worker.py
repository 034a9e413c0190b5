# SPDX-License-Identifier: Apache-2.0
"""What a Dask worker gets, the files of a driver and simulators or digests of what it must have, and what it does."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ds_base.bounded_file import read_regular
from ds_base.errors import InputError
from ds_base.folder_files import enter_folder, write_whole
from ds_driver.closed_loop.simulation import request_from_json
from ds_driver.networks.driver_name import DESCRIPTIONS, NO_GENERATORS, WEIGHTS, DriverName
from ds_orchestrator.engines.fingerprint import fingerprint
from ds_orchestrator.engines.local import LocalEngine, running_local
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.run_codec import encode_run

Key = tuple[str, float]
"""Digest of a parcel, and wall-clock time for one answer of the driver, s."""
LARGEST_PART = 2**29
"""Bytes of a file that is sent; chosen: the largest network."""


@dataclass(frozen=True, kw_only=True)
class Parcel:
    """Files of one campaign, for workers without its folders."""

    driver: DriverName  # the driver's name where the campaign runs, as those of the simulators
    driver_sha256: str  # digest of its files; "" for the autopilot
    backend: str  # back end that runs its network; "" for the autopilot
    simulators: tuple[SimulatorName, ...]
    files: dict[str, bytes] = field(default_factory=dict)  # path relative to the worker's folder -> content
    # Name here -> name there, in which `{folder}` stands for the worker's folder.
    renamed: dict[str, str] = field(default_factory=dict)

    @cached_property
    def sha256(self) -> str:
        """Digest of the files and names."""
        digest = hashlib.sha256(repr((str(self.driver), self.driver_sha256, self.simulators, self.renamed)).encode())
        for name, content in sorted(self.files.items()):
            digest.update(f"{name}\n{len(content)}\n".encode() + content)
        return digest.hexdigest()

    def unpack(self, folder: Path) -> None:
        """Write the files into a folder, created if missing."""
        enter_folder(folder)
        for name, content in self.files.items():
            write_whole(folder / name, content)

    def simulator_there(self, simulator: SimulatorName, folder: Path) -> SimulatorName:
        """Translate a simulator's name to its name on a worker."""
        return SimulatorName(self._there(simulator, folder))

    def driver_there(self, driver: DriverName, folder: Path) -> DriverName:
        """Translate a driver's name to its name on a worker."""
        return DriverName.parse(self._there(str(driver), folder))

    def _there(self, name: str, folder: Path) -> str:
        return self.renamed.get(name, name).replace("{folder}", str(folder))


def parcel_of(driver: DriverName, simulators: Sequence[SimulatorName]) -> Parcel:
    """Pack a driver and simulators; InputError if a description refers to a file outside of its folder."""
    from ds_driver.networks.network_driver import driver_sha256

    files: dict[str, bytes] = {}
    renamed: dict[str, str] = {}
    for number, simulator in enumerate(simulators):
        if simulator.file:
            place = f"simulators/{number}/{Path(simulator.file).name}"
            files[place] = read_regular(Path(simulator.file), LARGEST_PART)
            renamed[simulator] = f"{simulator.base}@{{folder}}/{place}"
    return Parcel(
        driver=driver,
        driver_sha256=driver_sha256(driver),
        backend=_pack_driver(driver, files, renamed) if driver.has_files else "",
        simulators=tuple(simulators),
        files=files,
        renamed=renamed,
    )


def _pack_generators(name: DriverName, files: dict[str, bytes]) -> str:
    """Add the generators that a worker does not have; return what follows the network's name there."""
    from ds_driver.networks.network_driver import generators_of
    from ds_driver.networks.weights import GENERATORS, shipped_sets

    generators = generators_of(name)
    if name.generators == NO_GENERATORS or name.generators in shipped_sets():
        return f"+{name.generators}"
    if generators is None:
        return ""
    if name.generators or name.file_type == WEIGHTS:
        # Beside the weights, where a network looks for the generators that it was trained with.
        files |= {
            f"driver/{GENERATORS}/{label}.safetensors": read_regular(path, LARGEST_PART)
            for label, path in generators.files.items()
        }
    return f"+{{folder}}/driver/{GENERATORS}" if name.generators else ""


def _pack_driver(driver: DriverName, files: dict[str, bytes], renamed: dict[str, str]) -> str:
    """Add a driver's files; return its back end."""
    from ds_driver.networks.description import file_of, read_description
    from ds_driver.networks.network_driver import on_backend

    name = on_backend(driver)
    path = Path(name.network)
    ending = _pack_generators(name, files) + name.suffix
    if name.file_type in DESCRIPTIONS:
        network = file_of(path, read_description(path))
        try:
            inside = network.resolve().relative_to(path.resolve().parent)
        except ValueError:
            raise InputError(
                f"{path.name} names the network {network}, outside of its folder: put both into one folder, so that "
                "they can be sent to other machines"
            ) from None
        files |= {
            f"driver/{path.name}": read_regular(path, LARGEST_PART),
            f"driver/{inside}": read_regular(network, LARGEST_PART),
        }
    elif name.file_type == WEIGHTS:
        files[f"driver/{path.name}"] = read_regular(path, LARGEST_PART)
    else:  # shipped, or a class: the worker has it, and its digest is compared
        if name.network + ending != str(driver):
            renamed[str(driver)] = name.network + ending
        return "" if name.python_class else name.backend
    renamed[str(driver)] = f"{{folder}}/driver/{path.name}{ending}"
    return "torch openvino" if name.backend == "auto" else name.backend


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

    Returns the number of drives at a time; ValueError if the driver here is not the one there, or a simulator cannot
    be made.
    """
    from distributed import get_worker

    from ds_driver.networks.network_driver import driver_sha256

    worker = get_worker()
    folder = Path(worker.local_directory) / "digital_siblings" / key[0][:16]
    with _lock:
        for other in [other for other, one in _prepared.items() if not one.engine.drives]:
            _prepared.pop(other).stack.close()
    parcel.unpack(folder)
    driver = parcel.driver_there(parcel.driver, folder)
    if parcel.driver_sha256 and driver_sha256(driver) != parcel.driver_sha256:
        raise ValueError(f"driver {parcel.driver} has other content there")
    for simulator in parcel.simulators:
        make_simulator(parcel.simulator_there(simulator, folder)).close()
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
