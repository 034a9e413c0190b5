# SPDX-License-Identifier: Apache-2.0
"""Starts graphs of ROS nodes, each in a ROS domain of its own, drives on them, and always stops them."""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from queue import SimpleQueue

from ds_base.errors import RunError
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.engine import DriveSettings, Engine, Watch
from ds_orchestrator.engines.local import LocalEngine, running_local
from ds_orchestrator.graph.client import START_TIME, GraphClient
from ds_orchestrator.graph.signals import IgnoreSignals
from ds_orchestrator.graph.supervisor import Supervisor, closed_loop_processes
from ds_sim.registry import SimulatorName
from ds_sim.session import RunRecord

LOCKS = Path("/tmp")
"""Shared by all users of the machine; a folder per user would not keep two users apart."""


class RosDomain:
    """Reserves a free domain, `number`, until it is closed or its process ends; RunError if all are in use."""

    def __init__(self) -> None:
        for number in range(1, 102):  # 0 is ROS's default; up to 101 are safe on every system
            path = LOCKS / f"ds_ros_domain_{number}.lock"
            try:
                # Another user's file in /tmp may be opened, but not with O_CREAT (fs.protected_regular).
                file = os.open(path, os.O_RDONLY | (0 if path.exists() else os.O_CREAT), 0o644)
            except OSError:
                continue
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(file)
                continue
            self.number, self._file = number, file
            return
        raise RunError("all ROS domains from 1 to 101 are in use: stop another campaign first")

    def close(self) -> None:
        """Release the domain."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


class GraphEngine:
    """Gives each drive to a graph with a free simulator of that name.

    A run depends on road, seed, conditions and commands alone, so any graph may drive it: each has every simulator.
    Probed requests, which no node drives, go to an engine that is started at the first of them.
    """

    def __init__(
        self, graphs: Sequence[Engine], simulators: Sequence[SimulatorName], start_probing: Callable[[], Engine]
    ) -> None:
        self._graphs = graphs
        self._free: dict[SimulatorName, SimpleQueue[Engine]] = {name: SimpleQueue() for name in simulators}
        for name, free in self._free.items():
            # A simulator that is another program has one vehicle, so one graph drives it.
            for graph in self._graphs[:1] if name.is_external else self._graphs:
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


@contextmanager
def running_graph(
    namespaces: dict[SimulatorName, str],
    driver: DriverName,
    *,
    command_timeout: float,
    logs: Path,
    attach: bool = False,
    draw: str = "all",
    wait: float = START_TIME,
) -> Iterator[GraphClient]:
    """Start a graph, yield it when it is ready to drive, and stop it; each simulator's process has its own driver, too.

    With `attach`, nothing is started: nodes are used that run in the environment's ROS domain. `draw` is `all`, or
    `seen` for only those rows of the images that somebody looks at. A simulator waits `command_timeout` s of wall-clock
    time for its driver; GraphError if nodes take longer than `wait` s to start, ProcessError if a process ends.
    """
    with ExitStack() as stack:
        signals_ignored = IgnoreSignals()
        stack.push(signals_ignored.__exit__)
        supervisor = None
        domain = None
        if not attach:
            reserved = RosDomain()
            stack.callback(reserved.close)
            domain = reserved.number
            specs = closed_loop_processes(driver, namespaces, command_timeout, draw=draw)
            supervisor = Supervisor(specs, domain=domain, logs=logs)
            stack.callback(supervisor.close)
        client = GraphClient(namespaces, domain=domain, command_timeout=command_timeout, supervisor=supervisor)
        stack.callback(client.close)
        stack.callback(signals_ignored.__enter__)
        client.wait_until_ready(wait)
        client.check_simulators()
        yield client


@contextmanager
def running_graphs(settings: DriveSettings, *, logs: Path) -> Iterator[GraphEngine]:
    """Start the engine `graph`, yield it when its graphs are ready to drive, and stop it; errors: see `running_graph`.

    Worker processes without ROS drive what is to be probed; their drives are the same. Each of several graphs writes
    its logs into a subfolder `worker_<number>`, from 1.
    """
    count, timeout = settings.workers, settings.command_timeout
    with ExitStack() as stack:

        def start_probing() -> LocalEngine:
            return stack.enter_context(
                running_local(AUTOPILOT, workers=count, command_timeout=timeout, logs=logs / "gates")
            )

        graphs = [
            stack.enter_context(
                running_graph(
                    settings.namespaces,
                    settings.driver,
                    command_timeout=timeout,
                    attach=settings.attach,
                    draw="seen",
                    logs=logs if count == 1 else logs / f"worker_{number}",
                )
            )
            for number in range(1, count + 1)
        ]
        yield GraphEngine(graphs, settings.simulators, start_probing)
