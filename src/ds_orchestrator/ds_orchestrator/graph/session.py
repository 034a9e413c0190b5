"""Brings a graph up, gives it to whoever drives with it, and takes it down again whatever happens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ds_orchestrator.graph.executor import START_TIME, GraphExecutor
from ds_orchestrator.graph.process_specs import driver_process, simulator_processes
from ds_orchestrator.graph.ros_domain import RosDomain
from ds_orchestrator.graph.shared_memory import remove_leftovers
from ds_orchestrator.graph.signals import IgnoreSignals
from ds_orchestrator.graph.supervisor import Supervisor
from ds_orchestrator.graph.worker_pool import WorkerPool


@contextmanager
def running_graph(
    namespaces: dict[str, str],
    driver: str,
    *,
    command_timeout: float,
    logs: Path,
    attach: bool = False,
    wait: float = START_TIME,
    report: Callable[[str], None] = lambda line: None,
) -> Iterator[GraphExecutor]:
    """A graph that is ready to drive.

    Args:
        namespaces: simulator name -> namespace.
        driver: `autopilot`, a shipped network, or a weights file.
        command_timeout: s that a simulator waits for its driver.
        logs: folder for the processes' logs.
        attach: start nothing, use the nodes that run already in this environment's ROS domain.
        wait: s that the nodes get to come up.
        report: called with one line when a run has to wait for another client.

    Raises:
        ds_orchestrator.graph.executor.GraphError: it does not come up.
        ds_orchestrator.graph.supervisor.ProcessError: one of its processes ended.
    """
    with ExitStack() as stack:
        deaf = IgnoreSignals()
        stack.push(deaf.__exit__)
        supervisor = None
        domain = None
        if not attach:
            remove_leftovers()
            held = RosDomain()
            stack.callback(held.close)
            domain = held.number
            specs = [*simulator_processes(namespaces, command_timeout), driver_process(driver, namespaces)]
            supervisor = Supervisor(specs, domain=domain, logs=logs)
            stack.callback(supervisor.close)
        executor = GraphExecutor(
            namespaces, domain=domain, command_timeout=command_timeout, supervisor=supervisor, report=report
        )
        stack.callback(executor.close)
        stack.callback(deaf.__enter__)
        executor.wait_until_ready(wait)
        executor.check_simulators()
        yield executor


@contextmanager
def running_workers(
    count: int, namespaces: dict[str, str], driver: str, *, command_timeout: float, logs: Path
) -> Iterator[WorkerPool]:
    """So many graphs that are ready to drive; each keeps its logs in a folder `worker_<number>`, from 1.

    Raises:
        ds_orchestrator.graph.executor.GraphError: one does not come up.
        ds_orchestrator.graph.supervisor.ProcessError: a process of one ended.
    """
    with ExitStack() as stack:
        graphs = [
            stack.enter_context(
                running_graph(namespaces, driver, command_timeout=command_timeout, logs=logs / f"worker_{number}")
            )
            for number in range(1, count + 1)
        ]
        yield WorkerPool(graphs, list(namespaces))
