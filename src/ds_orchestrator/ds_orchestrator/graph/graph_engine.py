"""Engine `graph`: one or several graphs of ROS nodes, each with its own processes and ROS domain."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue

from ds_driver.closed_loop.drive_request import DriveRequest
from ds_orchestrator.campaign.engine import Engine, Watch
from ds_sim.session import RunRecord


class GraphEngine:
    """Gives each drive to a graph with a free simulator of that name.

    A run depends on road, seed, conditions and commands alone, so any graph may drive it.

    Args:
        graphs: each with every simulator.
        simulators: names of the simulators.
        start_probing: starts an engine for requests that are probed, which no node does; called at the first one.
    """

    def __init__(
        self, graphs: Sequence[Engine], simulators: Sequence[str], start_probing: Callable[[], Engine]
    ) -> None:
        self._graphs = list(graphs)
        self._free: dict[str, SimpleQueue[Engine]] = {name: SimpleQueue() for name in simulators}
        for free in self._free.values():
            for graph in self._graphs:
                free.put(graph)
        self._start_probing, self._probing = start_probing, threading.Lock()
        self._probe: Engine | None = None

    @property
    def capacity(self) -> int | None:
        """None: each simulator takes as many drives as there are graphs."""
        return None

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        """Drive a road as soon as a graph is free; see `Engine.drive`."""
        if request.probed:
            with self._probing:
                self._probe = self._probe or self._start_probing()
            return self._probe.drive(request, watch)
        graph = self._free[request.simulator].get()
        try:
            return graph.drive(request, watch)
        finally:
            self._free[request.simulator].put(graph)

    def stop(self) -> None:
        """End every drive now, as CANCELLED."""
        for engine in (*self._graphs, *([self._probe] if self._probe else [])):
            engine.stop()
