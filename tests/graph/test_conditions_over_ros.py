# SPDX-License-Identifier: Apache-2.0
"""Conditions cross ROS: each run has those of its goal, or its node's; what a simulator cannot realise is refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rclpy
from ds_interfaces.action import DriveRoad
from ds_interfaces.msg import Condition
from ds_interfaces.srv import LoadRoad
from rclpy.action import ActionClient
from rclpy.node import Node
from tests.drives import driven

from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.executor import trajectory_sha256 as digest
from ds_orchestrator.graph import session, supervisor
from ds_orchestrator.store.rows import trajectory_sha256
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import DONKEY, SimulatorName
from ds_sim.ros import conversions as messages
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome, Reason

pytestmark = pytest.mark.graph

QUICK = SimulatorName("tests.engines.quick_simulator:QuickSimulator")
SPACES = {DONKEY: "/ds1", QUICK: "/ds2"}
SHORT = Road([(125.0, 40.0), (125.0, 65.0), (128.0, 90.0), (131.0, 115.0), (131.0, 140.0)])
OF_NODE, OF_GOAL = Conditions(tyre_pull=0.01), Conditions(steering_lag=0.3, tyre_pull=-0.01)


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A donkey whose node has conditions of its own, and a simulator that knows none."""
    processes = supervisor.closed_loop_processes

    def with_conditions(*arguments: Any, **options: Any) -> Any:
        donkey, quick = processes(*arguments, **options)
        return [replace(donkey, parameters={**donkey.parameters, "conditions": "tyre_pull=0.01"}), quick]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "closed_loop_processes", with_conditions)
        logs = tmp_path_factory.mktemp("logs")
        with session.running_graph(SPACES, AUTOPILOT, command_timeout=10.0, logs=logs) as executor:
            yield executor


def of_library(conditions: Conditions) -> str:
    return digest(driven(DONKEY, SHORT, 5, conditions))


@pytest.mark.parametrize(
    ("given", "expected"), [(OF_GOAL, OF_GOAL), (DEFAULT, DEFAULT), (None, OF_NODE)], ids=["goal", "default", "node"]
)
def test_a_run_has_the_conditions_of_its_goal_or_else_of_its_node(
    graph: Any, given: Conditions | None, expected: Conditions
) -> None:
    run = graph.execute(DONKEY, Scenario(SHORT, given or DEFAULT, seed=5), conditions_of_node=given is None)
    assert run.conditions == expected
    assert digest(run) == of_library(expected)


def test_what_a_simulator_cannot_realise_is_refused_and_no_run_is_made(graph: Any) -> None:
    refused = graph.execute(QUICK, Scenario(SHORT, Conditions(friction=0.5), seed=5))
    assert (refused.outcome, refused.reason) == (Outcome.SIM_ERROR, Reason.NOT_APPLICABLE)
    assert refused.message == "quick cannot realise friction: it realises none"
    assert not refused.observations
    assert graph.execute(QUICK, Scenario(SHORT, seed=5)).outcome.is_verdict


def test_loaded_conditions_hold_for_the_goal_that_brings_no_road(graph: Any, join: Callable[[int], None]) -> None:
    join(graph.context.get_domain_id())
    node = Node("tester")
    client, action = node.create_client(LoadRoad, "/ds1/load_road"), ActionClient(node, DriveRoad, "/ds1/drive_road")
    assert client.wait_for_service(10.0) and action.wait_for_server(10.0)

    def wait(future: Any) -> Any:
        rclpy.spin_until_future_complete(node, future, timeout_sec=30.0)
        return future.result()

    def load(*conditions: Condition) -> Any:
        road = messages.road_to_message(SHORT)
        return wait(client.call_async(LoadRoad.Request(road=road, seed=5, conditions=conditions)))

    assert load(*messages.conditions_to_messages(OF_GOAL)).accepted
    for bad, named in (("fog", "unknown condition 'fog'"), ("friction", "friction is 9, expected 0.1 to 1")):
        answer = load(Condition(name=bad, value=9.0))
        assert not answer.accepted and answer.reason.value == Reason.BAD_GOAL and named in answer.message
    run = wait(wait(action.send_goal_async(DriveRoad.Goal())).get_result_async()).result
    action.destroy()
    node.destroy_node()
    assert messages.conditions_from_messages(run.conditions) == OF_GOAL
    columns = (run.trajectory.x, run.trajectory.y, run.trajectory.yaw, run.trajectory.speed)
    assert trajectory_sha256(np.column_stack(columns)) == of_library(OF_GOAL)
