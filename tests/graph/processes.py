# SPDX-License-Identifier: Apache-2.0
"""Simulators and drivers in processes of their own, as launch files start them, each graph in its own ROS domain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from tests.waiting import wait_until

from ds_orchestrator.graph.client import GraphClient
from ds_orchestrator.graph.session import RosDomain
from ds_orchestrator.graph.supervisor import ProcessSpec, Supervisor
from ds_road import Road
from ds_sim.registry import DONKEY, SimulatorName
from ds_sim.ros.node_thread import NodeThread
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord

SPACE = {DONKEY: "/ds1"}
SHORT = Road([(125.0, 25.0 * i) for i in range(1, 6)])
"""100 m straight on."""


def simulator_processes(
    namespaces: dict[SimulatorName, str], command_timeout: float, **more: object
) -> list[ProcessSpec]:
    """One process per simulator, with `more` parameters."""
    return [
        ProcessSpec(
            name=f"simulator_{namespace.strip('/')}",
            module="ds_sim.ros.simulator_node",
            namespace=namespace,
            parameters={"simulator": name, "command_timeout": command_timeout, **more},
        )
        for name, namespace in namespaces.items()
    ]


@contextmanager
def supervised(specs: Sequence[ProcessSpec], logs: Path) -> Iterator[tuple[Supervisor, int]]:
    """Run processes in a free ROS domain, and yield its number, too."""
    domain = RosDomain()
    supervisor = Supervisor(specs, domain=domain.number, logs=logs)
    try:
        yield supervisor, domain.number
    finally:
        supervisor.close()
        domain.close()


@contextmanager
def driven_graph(specs: Sequence[ProcessSpec], logs: Path) -> Iterator[tuple[GraphClient, int]]:
    """Run processes, one of them a donkey in `SPACE`, and yield a client that drives on it, and their ROS domain."""
    with supervised(specs, logs) as (supervisor, domain):
        client = GraphClient(SPACE, domain=domain, command_timeout=10.0, supervisor=supervisor)
        try:
            yield client, domain
        finally:
            client.close()


def watched_run(
    graph: GraphClient,
    simulator: SimulatorName,
    scenario: Scenario,
    node: str,
    topics: dict[str, Any],
    *,
    last: int = 1,
) -> tuple[RunRecord, dict[str, list[Any]]]:
    """Drive, and hear a node's topics, given with their types, of every frame, or all but the `last` one if it is 0."""
    listener = Node("listener", context=graph.context)
    heard: dict[str, list[Any]] = {topic: [] for topic in topics}
    for topic, kind in topics.items():
        listener.create_subscription(kind, topic, heard[topic].append, 1000)
    # Whoever answers a client that was created after the subscriptions has heard of them.
    client = listener.create_client(GetParameters, f"{node}/get_parameters")
    thread = NodeThread(listener)
    assert thread.ask(client, GetParameters.Request(names=["use_sim_time"]), 30.0)
    run = graph.execute(simulator, scenario)
    wait_until(lambda: min(map(len, heard.values())) >= run.steps + last)
    assert thread.end()
    listener.destroy_node()
    return run, heard
