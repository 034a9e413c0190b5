# SPDX-License-Identifier: Apache-2.0
"""Engine `local`: worker processes on this machine, each with several simulators and one network."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path

from ds_base.folder_files import enter_folder
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.closed_loop.worker_process import WorkerProcess
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.engine import Watch
from ds_sim.session import RunRecord

DRIVES_PER_WORKER = 4
"""Drives of one process at a time; chosen by measurement (docs/speed.md): more gain little, and wait for each other."""


class LocalEngine:
    """Gives each drive to the started process that drives least, at most `drives_each` at a time."""

    def __init__(self, workers: list[WorkerProcess], drives_each: int) -> None:
        self._busy = dict.fromkeys(workers, 0)
        self._drives_each = drives_each
        self._changed = threading.Condition()
        self._vehicles: dict[str, AbstractContextManager[object]] = defaultdict(threading.Lock)

    @property
    def drives(self) -> int:
        """Drives in progress."""
        return sum(self._busy.values())

    @property
    def capacity(self) -> int:
        """Drives at a time."""
        return len(self._busy) * self._drives_each

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        """Drive a road as soon as a process has room, and the simulator if it has one vehicle; gives no feedback."""
        with self._vehicles[request.simulator] if request.simulator.is_external else nullcontext():
            with self._changed:
                self._changed.wait_for(lambda: min(self._busy.values()) < self._drives_each)
                worker = min(self._busy, key=lambda one: self._busy[one])
                self._busy[worker] += 1
            try:
                return worker.drive(request)
            finally:
                with self._changed:
                    self._busy[worker] -= 1
                    self._changed.notify()

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        for worker in self._busy:
            worker.stop()


@contextmanager
def running_local(driver: DriverName, *, workers: int, command_timeout: float, logs: Path) -> Iterator[LocalEngine]:
    """Start the processes, yield an engine, and end them; WorkerError if one does not start, or cannot load the driver.

    Answers of the driver may take `command_timeout` s of wall-clock time. Each process has a log in the folder.
    """
    enter_folder(logs)
    with ExitStack() as stack:
        threads = stack.enter_context(ThreadPoolExecutor(workers))
        pool = []
        for number in range(1, workers + 1):
            log = logs / f"worker_{number}.log"
            pool.append(WorkerProcess(driver, command_timeout=command_timeout, log=log))
            stack.callback(pool[-1].close)
        batches = threads.map(WorkerProcess.start, pool)
        yield LocalEngine(pool, min(DRIVES_PER_WORKER, *batches))
