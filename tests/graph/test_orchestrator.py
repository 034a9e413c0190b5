# SPDX-License-Identifier: Apache-2.0
"""The orchestrator's node, asked by action clients: real simulators and drivers in the same domain."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from benchmarks.kill import stored
from diagnostic_msgs.msg import DiagnosticArray
from ds_interfaces.action import DriveTests, RunCampaign
from ds_interfaces.msg import CampaignState, Condition, MapLegend
from ds_interfaces.msg import TestOutcome as DrivenTest
from ds_interfaces.srv import GetMap, GetState, GetTest
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tests.graph.processes import supervised

from ds_base.bounded_yaml import load_yaml
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.folder import open_store
from ds_orchestrator.graph.supervisor import ProcessSpec, Supervisor, closed_loop_processes
from ds_road import generate
from ds_sim import BULLET, DONKEY
from ds_sim.ros.conversions import road_to_message
from ds_studies.whole_campaign import run_campaign

pytestmark = pytest.mark.graph

CONFIG = """
siblings: [bullet]
twin: donkey
driver: autopilot
record: none
seed: 5
search: {population: 2, iterations: 2, runs: 1, min_angle: 40, max_angle: 120}
"""
DRIVES = 8
LIMIT = 120.0
CAMPAIGN = "orchestrator: campaign"
STATUSES = {CAMPAIGN, "simulator: simulator", "autopilot: latency"}
"""Names of what `/diagnostics` shows of the graph."""
LATCHED = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MODULE = "ds_studies.ros.orchestrator_node"


@dataclass
class Graph:
    """Running orchestrator, simulators and drivers, and a node that asks them."""

    node: Any
    supervisor: Any
    root: Path
    domain: int
    clients: dict[str, Any] = field(default_factory=dict)

    def until(self, done: Callable[[], Any], limit: float = LIMIT) -> Any:
        deadline = time.monotonic() + limit
        while not (found := done()):
            assert time.monotonic() < deadline, "nothing happened in time"
            rclpy.spin_once(self.node, timeout_sec=0.1)
        return found

    def wait(self, future: Any) -> Any:
        self.until(future.done)
        return future.result()

    def ask(self, kind: Any, service: str, **fields: Any) -> Any:
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready)
        return self.wait(client.call_async(kind.Request(**fields)))

    def client(self, kind: Any, name: str) -> Any:
        """Client of an action, kept, as its discovery may take seconds in which drives end."""
        if name not in self.clients:
            self.clients[name] = ActionClient(self.node, kind, name)
        self.until(self.clients[name].server_is_ready)
        return self.clients[name]

    def latest(self, topics: dict[str, Any]) -> dict[str, Any]:
        """Topic -> its latest message, once there is one; takes topic -> type."""
        seen: dict[str, Any] = {}
        for name, kind in topics.items():
            self.node.create_subscription(kind, name, partial(seen.__setitem__, name), LATCHED)
        return seen

    def send(self, kind: Any, name: str, feedback: Callable[[Any], None] | None = None, **fields: Any) -> Any:
        return self.wait(self.client(kind, name).send_goal_async(kind.Goal(**fields), feedback_callback=feedback))

    def run(self, kind: Any, name: str, **fields: Any) -> tuple[int, Any]:
        found = self.wait(self.send(kind, name, **fields).get_result_async())
        return found.status, found.result


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    root = tmp_path_factory.mktemp("root")
    specs = [
        *closed_loop_processes(AUTOPILOT, {BULLET: "/ds1", DONKEY: "/twin"}, 10.0),
        ProcessSpec(name="orchestrator", module=MODULE, parameters={"root": str(root)}),
    ]
    with supervised(specs, tmp_path_factory.mktemp("logs")) as (supervisor, domain):
        rclpy.init(domain_id=domain)
        yield Graph(Node("asker"), supervisor, root, domain)
        rclpy.try_shutdown()


@pytest.fixture(scope="module")
def campaign(graph: Graph) -> tuple[int, Any, list[Any]]:
    """A campaign on the running nodes: status, result, and what its feedback said."""
    states: list[Any] = []
    listen, goal = lambda message: states.append(message.feedback.state), {"config": CONFIG, "folder": "c"}
    handle = graph.send(RunCampaign, "run_campaign", listen, **goal, engine="attach")
    found = graph.wait(handle.get_result_async())
    return found.status, found.result, states


def test_a_campaign_on_running_nodes_is_the_campaign_that_runs_without_ros(
    graph: Graph, campaign: tuple[int, Any, list[Any]], tmp_path: Path
) -> None:
    status, result, states = campaign
    assert (status, result.message, result.executions, result.errors) == (4, "", DRIVES, 0)
    assert Path(result.report).is_file()
    config = parse_config(load_yaml(CONFIG), "here").model_copy(update={"engine": "local"})
    run_campaign(config, tmp_path / "local")
    assert stored(graph.root / "c") == stored(tmp_path / "local")
    assert {state.stage for state in states} & {"search", "migration and twin"}
    done = [state.done for state in states]
    assert done == sorted(done) and states[-1].expected == DRIVES
    assert all(state.seconds_left >= -1.0 for state in states)


def test_whoever_comes_late_sees_outcomes_maps_and_state(graph: Graph, campaign: tuple[int, Any, list[Any]]) -> None:
    outcomes: list[Any] = []
    graph.node.create_subscription(DrivenTest, "finished_tests", outcomes.append, LATCHED)
    grids = dict.fromkeys(("maps/union_bullet", "maps/merged", "maps/twin_donkey"), OccupancyGrid)
    seen = graph.latest({"map_legend": MapLegend, "campaign_state": CampaignState, **grids})
    graph.node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: seen.update({m.status[0].name: m}), 10)
    graph.until(lambda: len(outcomes) == DRIVES and len(seen) == 5 + len(STATUSES))
    assert set(seen) >= STATUSES
    store = open_store(graph.root / "c")
    driven = {(one.test_id, one.simulator): one for one in store.executions()}
    for one in outcomes:
        known = driven[one.test_id, one.simulator]
        assert (one.campaign, one.outcome.value, one.fitness) == ("c", int(known.outcome), known.fitness)
    legend, grid = seen["map_legend"], seen["maps/twin_donkey"]
    assert (len(legend.columns), len(legend.rows)) == (grid.info.width, grid.info.height)
    failed = sum(one.outcome.is_failure for (_, name), one in driven.items() if name == "donkey")
    answer = graph.ask(GetMap, "get_map", name="twin_donkey")
    assert answer.found and sum(answer.tests) == DRIVES // 2 and list(answer.grid.data) == list(grid.data)
    assert round(sum(n * p / 100 for n, p in zip(answer.tests, grid.data, strict=True) if n), 1) == failed
    assert [p < 0 for p in grid.data] == [n == 0 for n in answer.tests]
    assert "expected one of" in graph.ask(GetMap, "get_map", name="nonsense").message
    test = graph.ask(GetTest, "get_test", test_id="bullet-0-0001")
    assert {(one.campaign, one.simulator) for one in test.outcomes} == {("c", "bullet"), ("c", "donkey")}
    assert test.road.control_points
    assert "such as bullet-0-0000" in graph.ask(GetTest, "get_test", test_id="x").message
    state = graph.ask(GetState, "get_state").state
    assert (state.state, state.folder, state.done) == (CampaignState.FINISHED, "c", DRIVES)
    assert all(seen[name].status[0].level == b"\0" for name in STATUSES)
    assert "the last run ended" in seen["simulator: simulator"].status[0].message
    latency = {value.key for value in seen["autopilot: latency"].status[0].values}
    assert {"frames answered", "frames refused", "latency p95 ms"} <= latency


def test_whoever_comes_late_sees_nothing_of_the_last_goal(graph: Graph, campaign: tuple[int, Any, list[Any]]) -> None:
    """Another campaign with its own seed and conditions, and then a goal that drives nothing."""
    steady: list[Any] = []
    listener = graph.node.create_subscription(DrivenTest, "finished_tests", steady.append, 1000)  # volatile
    graph.until(lambda: listener.get_publisher_count() == 1)
    fields: dict[str, Any] = {"conditions": [Condition(name="friction", value=0.8)], "seed": [7]}
    status, result = graph.run(RunCampaign, "run_campaign", config=CONFIG, folder="late", engine="local", **fields)
    assert (status, result.message) == (4, "")
    late_one, one_of_c = (
        next(one for one in open_store(graph.root / folder).tests() if one.test_id == "bullet-0-0000")
        for folder in ("late", "c")
    )
    assert dict(late_one.conditions.changed) == {"friction": 0.8} and late_one.road != one_of_c.road
    late: list[Any] = []
    graph.node.create_subscription(DrivenTest, "finished_tests", late.append, LATCHED)
    graph.until(lambda: len(late) >= DRIVES and len(steady) >= DRIVES)
    assert [one.campaign for one in late] == [one.campaign for one in steady] == ["late"] * DRIVES
    fields = {"conditions": fields["conditions"], "default_conditions": True}
    status, result = graph.run(RunCampaign, "run_campaign", config=CONFIG, folder="empty", **fields)
    assert (status, result.message) == (6, "conditions, and default_conditions: expected one of both")
    grids = dict.fromkeys(("maps/merged", "maps/twin_donkey"), OccupancyGrid)
    seen = graph.latest({"map_legend": MapLegend, **grids})
    later: list[Any] = []
    graph.node.create_subscription(DrivenTest, "finished_tests", later.append, LATCHED)
    graph.until(lambda: len(seen) == 3)
    assert [seen[name].info.width for name in ("maps/merged", "maps/twin_donkey")] == [0, 0]
    assert (seen["map_legend"].across, later) == ("", [])


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"folder": "../c"}, "expected a folder below"),
        ({"folder": "/tmp/c"}, "expected a folder below"),
        ({"folder": "link"}, "leads through a link"),
        ({"folder": "link/new"}, "leads through a link"),
        ({"folder": "new", "engine": "warp"}, "expected one of attach"),
        ({"folder": "new", "config": "nothing.yaml"}, "nothing.yaml"),
        ({"folder": "new", "config": "siblings: [bullet"}, "not YAML: line 2"),
        ({"folder": "new", "config": "sibling: [bullet]"}, "sibling"),
        ({"folder": "new", "config": "driver: os:system"}, "os:system"),
        ({"folder": "new", "config": "driver: ros@mine"}, "ros@mine is a ROS node that you start"),
        ({"folder": "new", "config": "siblings: [os:system]"}, "os:system"),
        ({"folder": "never"}, "run a campaign there first"),
    ],
)
def test_a_goal_that_cannot_be_gets_one_line(graph: Graph, fields: dict[str, str], expected: str) -> None:
    (graph.root / "link").unlink(missing_ok=True)
    (graph.root / "link").symlink_to(graph.root)
    status, result = graph.run(RunCampaign, "run_campaign", **fields)
    assert status == 6 and expected in result.message and "\n" not in result.message
    assert result.reason.value == 2  # BAD_GOAL


def test_a_cancelled_campaign_resumes_and_another_goal_waits(graph: Graph, tmp_path: Path) -> None:
    graph.client(DriveTests, "drive_tests")
    handle = graph.send(RunCampaign, "run_campaign", config=CONFIG, folder="d", engine="attach")
    graph.until(lambda: len(stored(graph.root / "d")) >= 2)
    twin = graph.supervisor._processes["closed_loop_twin"]
    twin.send_signal(signal.SIGSTOP)  # the campaign is not over before it is cancelled, however busy the machine is
    status, result = graph.run(DriveTests, "drive_tests", folder="e", driver="autopilot", simulators=["bullet"])
    assert (status, result.reason.value) == (6, 4) and "under way" in result.message  # BUSY
    graph.wait(handle.cancel_goal_async())
    found = graph.wait(handle.get_result_async())
    assert found.status == 5 and "the same goal resumes" in found.result.message
    twin.send_signal(signal.SIGCONT)
    kept = stored(graph.root / "d")
    assert 2 <= len(kept) < DRIVES
    status, result = graph.run(RunCampaign, "run_campaign", folder="d", engine="local")  # no config: the folder's
    assert (status, result.executions) == (4, DRIVES)
    assert stored(graph.root / "d") == stored(graph.root / "c") and kept.items() <= stored(graph.root / "d").items()


def test_given_roads_are_driven(graph: Graph) -> None:
    roads = [generate(np.random.default_rng(seed), max_angle=100) for seed in (1, 2)]
    fields: dict[str, Any] = {
        "folder": "given",
        "driver": "autopilot",
        "simulators": ["bullet", "softbody"],
        "seeds": [7, 8],
        "roads": [road_to_message(road) for road in roads],
    }
    status, result = graph.run(DriveTests, "drive_tests", **fields)
    assert (status, result.message) == (4, "")
    assert [(one.test_id, one.simulator) for one in result.outcomes] == [
        (f"given-0-000{number}", name) for number in (0, 1) for name in ("bullet", "softbody")
    ]
    assert all(one.outcome.value in (1, 2) for one in result.outcomes)
    engine = {path: path.stat().st_mtime_ns for path in (graph.root / "given").rglob("*.log")}
    assert engine
    again = graph.run(DriveTests, "drive_tests", **fields)[1]
    assert again.outcomes == result.outcomes
    assert engine == {path: path.stat().st_mtime_ns for path in engine}  # nothing is driven twice
    nodes = {"folder": "nodes", "driver": "ros@mine", "engine": "attach", "simulators": ["bullet"]}
    of_nodes = graph.run(DriveTests, "drive_tests", **fields | nodes)[1]
    assert [one.fitness for one in of_nodes.outcomes] == [one.fitness for one in result.outcomes[::2]]
    status, result = graph.run(DriveTests, "drive_tests", **fields | {"folder": "other", "seeds": [1]})
    assert status == 6 and "a seed for each road" in result.message


def test_a_second_orchestrator_is_noticed_and_a_signal_ends_a_goal(graph: Graph, tmp_path: Path) -> None:
    """After the others, since it ends the orchestrator."""
    spec = ProcessSpec(name="second", module=MODULE, parameters={"root": str(tmp_path)})
    second = Supervisor([spec], domain=graph.domain, logs=tmp_path)
    said: dict[str, str] = {}
    graph.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: said.update({m.status[0].name: m.status[0].message}), 10
    )
    graph.until(lambda: "2 orchestrators live in" in said.get(CAMPAIGN, ""))
    # Both answer a goal, and the client takes one answer.
    graph.until(lambda: "orchestrators live in" in graph.run(RunCampaign, "run_campaign", folder="g")[1].message)
    second.close()
    graph.until(lambda: "orchestrators" not in said[CAMPAIGN])
    long = CONFIG.replace("iterations: 2", "iterations: 98")  # 200 drives, not over before a signal comes
    handle = graph.send(RunCampaign, "run_campaign", config=long, folder="f", engine="local")
    graph.until(lambda: len(stored(graph.root / "f")) >= 1)
    result = handle.get_result_async()
    graph.supervisor.close()
    found = graph.wait(result)
    assert found.status == 6 and "a signal ended the node" in found.result.message
    assert len(stored(graph.root / "f")) < 200
