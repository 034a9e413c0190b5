"""Distributes runs over several graphs, each with its own processes and ROS domain."""

from __future__ import annotations

from collections.abc import Sequence
from queue import SimpleQueue

from ds_orchestrator.campaign.feedback import Watch, watched
from ds_orchestrator.campaign.runner import Executor
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.session import RunRecord


class WorkerPool:
    """Gives each run to a worker with a free simulator of that name.

    Satisfies `ds_orchestrator.campaign.runner.Executor`. A run depends on road, seed, conditions and commands
    alone, so any worker may drive it.

    Args:
        workers: executors, each with every simulator.
        simulators: names of the simulators.
    """

    gives_feedback = True

    def __init__(self, workers: Sequence[Executor], simulators: Sequence[str]) -> None:
        self._workers = list(workers)
        self._free: dict[str, SimpleQueue[Executor]] = {name: SimpleQueue() for name in simulators}
        for free in self._free.values():
            for worker in self._workers:
                free.put(worker)

    @property
    def capacity(self) -> int | None:
        """None: each simulator takes as many drives as there are workers."""
        return None

    def execute(
        self, simulator: str, road: Road, seed: int, conditions: Conditions = DEFAULT, *, watch: Watch | None = None
    ) -> RunRecord:
        """Drive a road as soon as a worker is free.

        Args:
            simulator: name of the simulator.
            road: road to drive.
            seed: seed of the run.
            conditions: operating conditions of the run.
            watch: called from another thread with the simulator's feedback.
        """
        worker = self._free[simulator].get()
        try:
            return watched(worker, watch)(simulator, road, seed, conditions)
        finally:
            self._free[simulator].put(worker)

    def stop(self) -> None:
        """End every active run now, as CANCELLED."""
        for worker in self._workers:
            worker.stop()
