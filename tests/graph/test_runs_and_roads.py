# SPDX-License-Identifier: Apache-2.0
"""Simulators and drivers as separate processes: roads, runs, their conditions, and their possible errors."""

from __future__ import annotations

import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from ds_interfaces.action import DriveRoad
from ds_interfaces.msg import Condition, DriveCommand, Frame
from ds_interfaces.msg import Road as RoadMessage
from ds_interfaces.srv import LoadRoad
from geometry_msgs.msg import Point
from rclpy.action import ActionClient
from rclpy.node import Node
from sensor_msgs.msg import Image
from tests.drives import driven
from tests.graph.processes import SPACE, driven_graph, simulator_processes, supervised
from tests.waiting import wait_until

from ds_base.processes import ChildProcesses
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.executor import trajectory_sha256 as digest
from ds_orchestrator.graph import client as graph_client
from ds_orchestrator.graph import session, supervisor
from ds_orchestrator.graph.session import RosDomain, running_graph
from ds_orchestrator.graph.supervisor import ProcessSpec
from ds_orchestrator.store.rows import trajectory_sha256
from ds_road import Road, generate
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import DONKEY, SimulatorName, spec_of
from ds_sim.ros import conversions as messages
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome, Reason
from ds_sim.testing import STRAIGHT

pytestmark = pytest.mark.graph

ROAD = generate(np.random.default_rng(21), max_angle=120)


@pytest.fixture(scope="module")
def shared_graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A donkey with the autopilot."""
    logs = tmp_path_factory.mktemp("logs")
    with running_graph(SPACE, AUTOPILOT, command_timeout=5.0, logs=logs) as executor:
        yield executor


@pytest.fixture
def graph(shared_graph: Any, join: Callable[[int], None]) -> Any:
    join(shared_graph.context.get_domain_id())
    return shared_graph


@pytest.fixture
def lonely_simulator(logs: Path, join: Callable[[int], None]) -> Iterator[Any]:
    """A donkey without a driver; yields (executor, ROS domain)."""
    with driven_graph(simulator_processes(SPACE, 10.0), logs) as (executor, domain):
        join(domain)
        yield executor, domain


def completes(graph: Any, road: Road = ROAD) -> None:
    run = graph.execute("donkey", Scenario(road, seed=5))
    assert run.outcome is Outcome.COMPLETED, run.message


def test_an_answer_that_comes_at_once_is_not_lost(graph: Any) -> None:
    """The goal's answer arrives before the request is registered: a slow sender, as on a busy machine."""

    class Slow:
        def __init__(self, handle: Any) -> None:
            self._handle = handle

        def __getattr__(self, name: str) -> Any:
            return getattr(self._handle, name)

        def send_goal_request(self, request: Any) -> Any:
            number = self._handle.send_goal_request(request)
            time.sleep(0.5)
            return number

    client = graph._simulators["donkey"].drive
    handle = client._client_handle
    client._client_handle = Slow(handle)
    started = time.monotonic()
    completes(graph)
    client._client_handle = handle
    assert time.monotonic() - started < 60.0  # a busy machine drives slowly


def test_another_clients_run_goes_on_until_that_client_is_gone(graph: Any, caplog: pytest.LogCaptureFixture) -> None:
    """The second client waits, reports for whom, and is refused; it ends the run once the first client is gone."""
    node = Node("somebody")
    client = ActionClient(node, DriveRoad, "/ds1/drive_road")
    assert client.wait_for_server(10.0)
    goal = DriveRoad.Goal(road=messages.road_to_message(ROAD), seed=1, sync="realtime")
    sent = client.send_goal_async(goal)
    rclpy.spin_until_future_complete(node, sent, timeout_sec=10.0)
    assert sent.result() is not None and sent.result().accepted
    caplog.set_level("INFO", "digital_siblings")
    limit, graph_client.BUSY_TIME = graph_client.BUSY_TIME, 1.0
    try:
        run = graph.execute("donkey", Scenario(ROAD, seed=5))
    finally:
        graph_client.BUSY_TIME = limit
    assert (run.outcome, run.reason, run.steps) == (Outcome.SIM_ERROR, Reason.BUSY, 0)
    assert ROAD.road_id in run.message and "/somebody" in run.message
    assert "/ds1 drives for /somebody: waiting 1 s at most" in caplog.messages
    node.destroy_node()
    completes(graph)


def test_a_simulator_in_the_wrong_namespace_is_noticed(graph: Any) -> None:
    graph.check_simulators()
    graph._simulators["bullet"] = graph._simulators["donkey"]
    try:
        with pytest.raises(graph_client.GraphError, match="/ds1 is donkey, expected bullet"):
            graph.check_simulators()
    finally:
        del graph._simulators["bullet"]


def test_bad_roads_are_refused_in_one_line_and_the_node_lives_on(graph: Any) -> None:
    """Roads that ds_road refuses are sent as messages, as any client could."""
    roads: dict[str, list[tuple[float, float]]] = {
        "nan": [(125.0, 0.0), (125.0, 25.0), (math.nan, 50.0), (125.0, 75.0)],
        "infinity": [(125.0, 0.0), (125.0, 25.0), (125.0, math.inf), (125.0, 75.0)],
        "one point": [(125.0, 25.0)],
        "100,000 points": [(float(i % 250), float(i // 250)) for i in range(100_000)],
        "crossing": [(50, 50), (50, 100), (50, 150), (100, 150), (100, 110), (20, 110), (10, 60)],
        "outside": [(125.0, 40.0 * i) for i in range(9)],
    }
    node = Node("tester")
    client = node.create_client(LoadRoad, "/ds1/load_road")
    assert client.wait_for_service(10.0)
    for name, points in roads.items():
        message = RoadMessage(control_points=[Point(x=float(x), y=float(y)) for x, y in points])
        future = client.call_async(LoadRoad.Request(road=message, seed=1))
        rclpy.spin_until_future_complete(node, future, timeout_sec=20.0)
        answer = future.result()
        assert answer is not None, name
        assert not answer.accepted and answer.reason.value == Reason.BAD_ROAD, name
        assert answer.message and "\n" not in answer.message, name
    node.destroy_node()
    completes(graph)


def test_another_driver_takes_the_wheel_without_touching_anything_else(
    lonely_simulator: Any, logs: Path, ended_with_this: ChildProcesses
) -> None:
    """The README's driver, in a separate process, drives a gentle road to its end."""
    executor, domain = lonely_simulator
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    command = [sys.executable, "examples/line_driver.py", "--ros-args", "-r", "__ns:=/ds1"]
    driver = ended_with_this.start(command, environment=environment, log=logs / "line_driver.log")
    try:
        completes(executor, generate(np.random.default_rng(2), max_angle=30))
    finally:
        driver.kill()
        driver.wait()


def test_a_simulator_that_nobody_starts_is_awaited_for_long_only_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(graph_client, "ABSENT_TIME", 2.0)
    domain = RosDomain()
    alone = graph_client.GraphClient(SPACE, domain=domain.number, command_timeout=5.0)
    monkeypatch.setattr(alone, "_start_time", 3.0)
    with caplog.at_level("INFO"):
        waits = [alone.execute(DONKEY, Scenario(ROAD, seed=1)).message.split(":")[0] for _ in range(2)]
    alone.close()
    domain.close()
    assert waits == [f"after {seconds} s there is no simulator in /ds1" for seconds in (3, 2)]
    assert caplog.messages == ["there is no simulator in /ds1: waiting 3 s at most"]


@pytest.mark.long
def test_a_node_that_stops_between_two_runs_is_replaced(graph: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """ROS forgets it after 20 s."""
    monkeypatch.setattr(graph, "_start_time", 5.0)
    graph._supervisor._processes["closed_loop_ds1"].send_signal(signal.SIGSTOP)
    wait_until(graph._simulators[DONKEY].missing)
    lost = graph.execute(DONKEY, Scenario(ROAD, seed=1))
    assert lost.outcome is Outcome.SIM_ERROR
    assert lost.message == "after 5 s there is no simulator in /ds1: see the folder logs"
    monkeypatch.undo()
    completes(graph)


def test_a_simulator_that_is_started_anew_during_a_run_is_an_error(graph: Any) -> None:
    """The new node never had the goal, and answers the question for its result, unless the old one's end is seen."""

    def watch(step: int, progress: float, lateral_position: float) -> None:
        if not restarts:
            restarts.append(step)
            graph._restart(graph._simulators[DONKEY])

    restarts: list[int] = []
    run = graph.execute(DONKEY, Scenario(ROAD, seed=1), watch=watch)
    assert restarts and run.outcome is Outcome.SIM_ERROR
    assert any(said in run.message for said in ("started anew during the run", "closed_loop_ds1 ended during the run"))
    completes(graph)


def test_a_driver_that_answers_nan_is_an_error_that_says_so(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user's class on PYTHONPATH; the log of the driver's process states the time of the answers."""
    (tmp_path / "late.py").write_text(
        "class Late:\n    def drive(self, seen):\n        return float('nan') if seen.step == 5 else 0.0\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with running_graph(SPACE, DriverName("late:Late"), command_timeout=6.0, logs=logs) as executor:
        run = executor.execute(DONKEY, Scenario(ROAD, seed=1))
    assert run.outcome is Outcome.DRIVER_SILENT and run.steps == 5
    assert "no command within 6 s" in run.message and "steering is nan" in run.message
    log = (logs / "closed_loop_ds1.log").read_text()
    assert "the network's steering is nan" in log and "5 frames answered: median" in log and "Traceback" not in log


def test_an_image_of_the_wrong_size_leaves_the_driver_alive(
    logs: Path, join: Callable[[int], None], spin: Callable[..., None]
) -> None:
    """The network driver refuses it in one line, and answers the next good image."""
    parameters: dict[str, object] = {"namespaces": list(SPACE.values()), "network": "dave2"}
    driver = ProcessSpec(name="driver", module="ds_driver.ros.driver_node", parameters=parameters)
    with supervised([driver], logs) as (_, domain):
        join(domain)
        node = Node("camera")
        frames = node.create_publisher(Frame, "/ds1/frame", 1)
        answers: list[DriveCommand] = []
        node.create_subscription(DriveCommand, "/ds1/drive", answers.append, 10)
        spin(node)

        def show(rows: int, columns: int, second: int) -> None:
            """Publish an image until it is answered; one of the wrong size for two seconds."""
            image = Image(height=rows, width=columns, encoding="rgb8", step=columns * 3)
            image.data = bytes(rows * columns * 3)
            image.header.stamp.sec = second
            until = time.monotonic() + (30.0 if rows == 160 else 2.0)
            while time.monotonic() < until and not (answers and answers[-1].header.stamp.sec == second):
                frames.publish(Frame(header=image.header, crop_top=40, image=image))
                time.sleep(0.1)

        wait_until(frames.get_subscription_count)
        for second, size in enumerate(((160, 320), (48, 64), (160, 320)), start=1):
            show(*size, second)
        assert {answer.header.stamp.sec for answer in answers} == {1, 3} and abs(answers[-1].steering) <= 1.0
        log = (logs / "driver.log").read_text()
        assert "frame not answered: image of shape (48, 64, 3)" in log and "Traceback" not in log
        node.destroy_node()


def _answer_all(name: str, steering: float) -> Any:
    """Create a driver in the test's process that answers every image."""
    node = Node(name)
    publisher = node.create_publisher(DriveCommand, "/ds1/drive", 1)

    def answer(image: Image) -> None:
        publisher.publish(DriveCommand(header=image.header, steering=steering, throttle=0.3))

    node.create_subscription(Image, "/ds1/camera/image_raw", answer, 1)
    return node


def test_two_drivers_are_noticed_and_named_and_give_no_verdict(
    lonely_simulator: Any, spin: Callable[..., None]
) -> None:
    """They are detected by their commands; a single one drives again."""
    names = ("driver", "another")
    executor, _ = lonely_simulator
    nodes = [_answer_all(name, steering) for name, steering in zip(names, (0.0, 0.4), strict=True)]
    spin(*nodes)
    executor.wait_until_ready(30.0)
    wait_until(lambda: nodes[0].count_subscribers("/ds1/camera/image_raw") == 2)
    run = executor.execute("donkey", Scenario(ROAD, seed=1))
    assert (run.outcome, run.reason) == (Outcome.SIM_ERROR, Reason.TWO_DRIVERS), run.message
    assert all(f"/{name}" in run.message for name in names) and run.steps < 5
    nodes[1].destroy_node()
    completes(executor, STRAIGHT)


def test_two_simulators_in_one_namespace_are_noticed_until_one_is_gone(
    graph: Any, logs: Path, ended_with_this: ChildProcesses
) -> None:
    """The second is killed, so that ROS still lists it for a while."""
    domain = graph.context.get_domain_id()
    command = [sys.executable, "-m", "ds_sim.ros.simulator_node", "--ros-args", "-r", "__ns:=/ds1"]
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    second = ended_with_this.start(command, environment=environment, log=logs / "second.log")
    try:
        both = (graph._supervisor._log("closed_loop_ds1"), logs / "second.log")
        wait_until(lambda: all("2 simulators live in /ds1" in log.read_text() for log in both))
        run = graph.execute("donkey", Scenario(ROAD, seed=1))
        assert (run.outcome, run.reason, run.steps) == (Outcome.SIM_ERROR, Reason.TWO_SIMULATORS, 0), run.message
    finally:
        second.kill()
        second.wait()
    wait_until(lambda: graph.execute("donkey", Scenario(ROAD, seed=1)).reason is not Reason.TWO_SIMULATORS)
    completes(graph)


def test_a_driver_without_parameters_asks_its_simulator_and_says_so(graph: Any) -> None:
    gains = spec_of("donkey").autopilot
    log = graph._supervisor._log("closed_loop_ds1").read_text()
    assert f"/ds1: gains from donkey: proportional {gains.proportional:g}" in log


QUICK = SimulatorName("tests.engines.quick_simulator:QuickSimulator")
SPACES = {DONKEY: "/ds1", QUICK: "/ds2"}
SHORT = Road([(125.0, 40.0), (125.0, 65.0), (128.0, 90.0), (131.0, 115.0), (131.0, 140.0)])
OF_NODE, OF_GOAL = Conditions(tyre_pull=0.01), Conditions(steering_lag=0.3, tyre_pull=-0.01)


@pytest.fixture(scope="module")
def conditioned(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
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
    conditioned: Any, given: Conditions | None, expected: Conditions
) -> None:
    run = conditioned.execute(DONKEY, Scenario(SHORT, given or DEFAULT, seed=5), conditions_of_node=given is None)
    assert run.conditions == expected
    assert digest(run) == of_library(expected)


def test_what_a_simulator_cannot_realise_is_refused_and_no_run_is_made(conditioned: Any) -> None:
    refused = conditioned.execute(QUICK, Scenario(SHORT, Conditions(friction=0.5), seed=5))
    assert (refused.outcome, refused.reason) == (Outcome.SIM_ERROR, Reason.NOT_APPLICABLE)
    assert refused.message == "quick cannot realise friction: it realises none"
    assert not refused.observations
    assert conditioned.execute(QUICK, Scenario(SHORT, seed=5)).outcome.is_verdict


def test_loaded_conditions_hold_for_the_goal_that_brings_no_road(conditioned: Any, join: Callable[[int], None]) -> None:
    join(conditioned.context.get_domain_id())
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
