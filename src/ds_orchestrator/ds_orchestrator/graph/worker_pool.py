"""Several graphs at once, each with its own processes and ROS domain, behind the face of one."""

from __future__ import annotations

from collections.abc import Sequence
from queue import SimpleQueue

from ds_orchestrator.campaign.runner import Executor
from ds_road import Road
from ds_sim.session import RunRecord


class WorkerPool:
    """Hands each run to a worker whose simulator of that name is free.

    Satisfies `ds_orchestrator.campaign.runner.Executor`.

    A run depends on road, seed and commands alone, so it does not matter which worker drives it.

    Args:
        workers: executors that each have every simulator.
        simulators: names.
    """

    def __init__(self, workers: Sequence[Executor], simulators: Sequence[str]) -> None:
        self._workers = list(workers)
        self._free: dict[str, SimpleQueue[Executor]] = {name: SimpleQueue() for name in simulators}
        for free in self._free.values():
            for worker in self._workers:
                free.put(worker)

    def execute(self, simulator: str, road: Road, seed: int) -> RunRecord:
        """Drive a road, as soon as a worker is free."""
        worker = self._free[simulator].get()
        try:
            return worker.execute(simulator, road, seed)
        finally:
            self._free[simulator].put(worker)

    def stop(self) -> None:
        """Let every run under way end now, as CANCELLED."""
        for worker in self._workers:
            worker.stop()
