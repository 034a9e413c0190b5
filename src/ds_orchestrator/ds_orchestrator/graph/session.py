"""Context managers that start graphs and always stop them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ds_driver.control.autopilot import AUTOPILOT
from ds_orchestrator.campaign.drive_settings import DriveSettings
from ds_orchestrator.engines.local import LocalEngine, running_local
from ds_orchestrator.graph.client import START_TIME, GraphClient
from ds_orchestrator.graph.graph_engine import GraphEngine
from ds_orchestrator.graph.process_specs import closed_loop_processes, driver_process, simulator_processes
from ds_orchestrator.graph.ros_domain import RosDomain
from ds_orchestrator.graph.signals import IgnoreSignals
from ds_orchestrator.graph.supervisor import ProcessSpec, Supervisor


def processes_of(
    driver: str, namespaces: dict[str, str], command_timeout: float, *, composed: bool, draw: str
) -> list[ProcessSpec]:
    """Specify the processes of a graph; see `running_graph`."""
    if composed:
        return closed_loop_processes(driver, namespaces, command_timeout, draw=draw)
    return [*simulator_processes(namespaces, command_timeout), driver_process(driver, namespaces)]


@contextmanager
def running_graph(
    namespaces: dict[str, str],
    driver: str,
    *,
    command_timeout: float,
    logs: Path,
    attach: bool = False,
    composed: bool = True,
    draw: str = "all",
    wait: float = START_TIME,
    report: Callable[[str], None] = lambda line: None,
) -> Iterator[GraphClient]:
    """Start a graph, yield it when it is ready to drive, and stop it.

    Args:
        namespaces: simulator name -> namespace.
        driver: `autopilot`, a shipped network, or a weights file.
        command_timeout: wall-clock time that a simulator waits for its driver, s.
        logs: folder for the processes' logs.
        attach: start nothing; use running nodes in the environment's ROS domain.
        composed: each simulator shares its process with a driver of its own; otherwise every node has a process, and
            one driver drives all.
        draw: `all`, or `seen` to draw, in a composed graph, only rows of the images that somebody looks at.
        wait: limit for the start of the nodes, s.
        report: called with one line when a run has to wait for another client.

    Raises:
        ds_orchestrator.graph.client.GraphError: the graph does not start.
        ds_orchestrator.graph.supervisor.ProcessError: one of its processes ended.
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
            specs = processes_of(driver, namespaces, command_timeout, composed=composed, draw=draw)
            supervisor = Supervisor(specs, domain=domain, logs=logs)
            stack.callback(supervisor.close)
        executor = GraphClient(
            namespaces,
            domain=domain,
            command_timeout=command_timeout,
            supervisor=supervisor,
            report=report,
        )
        stack.callback(executor.close)
        stack.callback(signals_ignored.__enter__)
        executor.wait_until_ready(wait)
        executor.check_simulators()
        yield executor


@contextmanager
def running_graphs(settings: DriveSettings, *, logs: Path) -> Iterator[GraphEngine]:
    """Start the engine `graph`, yield it when its graphs are ready to drive, and stop it.

    Worker processes without ROS drive what is to be probed; their drives are the same.

    Args:
        settings: simulators, driver, and number of graphs.
        logs: folder for logs; each of several graphs writes into a subfolder `worker_<number>`, from 1.

    Raises:
        ds_orchestrator.graph.client.GraphError: a graph does not start.
        ds_orchestrator.graph.supervisor.ProcessError: a process of a graph ended.
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
                    settings.namespaces, settings.driver, command_timeout=timeout, attach=settings.attach, draw="seen",
                    logs=logs if count == 1 else logs / f"worker_{number}",
                )
            )
            for number in range(1, count + 1)
        ]  # fmt: skip
        yield GraphEngine(graphs, settings.simulators, start_probing)
