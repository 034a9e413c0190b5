# SPDX-License-Identifier: Apache-2.0
"""docs/interfaces.md against the running graph: every topic, service, action and parameter, and nothing else.

Messages are compared with the plain values that they carry.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from ds_interfaces.msg import Outcome as OutcomeMsg
from ds_interfaces.msg import Reason as ReasonMsg
from ds_interfaces.msg import Road as RoadMsg
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from tests.graph.processes import supervised
from tests.waiting import wait_until

from ds_orchestrator.graph.supervisor import ProcessSpec
from ds_road import Road, RoadError
from ds_sim.messages import road_from_message
from ds_sim.ros.conversions import message_builder, road_to_message
from ds_sim.simulator import Outcome, Reason, VehicleState

pytestmark = pytest.mark.graph

DOCUMENT = Path("docs/interfaces.md")
GAINS = ("proportional", "derivative", "integral", "max_speed", "min_speed")
NODES: dict[str, tuple[str, dict[str, object]]] = {
    "simulator": ("ds_sim.ros.simulator_node", {"simulator": "donkey", "publish_clock": True}),
    "driver": ("ds_driver.ros.driver_node", {"crop_top": [0], "crop_bottom": [0]}),
    "autopilot": ("ds_driver.ros.autopilot_node", dict.fromkeys(GAINS, [1.0])),
    "cmd_vel_adapter": ("ds_driver.ros.cmd_vel_adapter_node", {"wheelbase": 2.0, "max_steering_angle": 0.5}),
    "camera_driver": ("ds_driver.ros.camera_driver_node", {}),
    "orchestrator": ("ds_studies.ros.orchestrator_node", {}),
}
"""Node -> module and parameters with which it has all of its documented interfaces."""
OPTIONAL = {
    "cmd_vel_adapter": {("calls", "get_info")},
    "camera_driver": {("subscribes", "camera/image_raw/compressed"), ("publishes", "cmd_vel")},
}
"""Interfaces that a node has only with other parameters, as its table says."""
EVERY_NODE = ("/parameter_events", "/rosout")
DIAGNOSTICS = re.compile(
    r"Every node (publishes) `(/diagnostics)` \(`(diagnostic_msgs/DiagnosticArray)`, (reliable, 1)\)"
)
"""What the document says of all nodes at once."""
TYPES = {
    1: "bool", 2: "int", 3: "double", 4: "string", 6: "bool[]", 7: "int[]", 8: "double[]", 9: "string[]",
}  # fmt: skip
"""rcl_interfaces/ParameterType in words."""


def tables(node: str) -> tuple[set[tuple[str, ...]], set[tuple[str, ...]]]:
    """Read the rows of a node's two tables: its interfaces and its parameters."""
    section = DOCUMENT.read_text().partition(f"\n## `{node}`\n")[2].partition("\n## ")[0]
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in section.splitlines() if "|" in line]
    rows = [tuple(cell.replace("`", "") for cell in row) for row in rows if set(row[0]) - {"-"} or len(row) < 3]
    kinds = ("publishes", "subscribes", "serves", "calls", "action")
    interfaces = {row for row in rows if row[0] in kinds}
    return interfaces, {row for row in rows if row[0] not in kinds and row[0] not in ("", "parameter")}


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """All nodes in one domain, each in a separate namespace, and a node that queries them."""
    specs = [
        ProcessSpec(name=name, module=module, namespace=f"/{name}_space", parameters=parameters)
        for name, (module, parameters) in NODES.items()
    ]
    with supervised(specs, tmp_path_factory.mktemp("logs")) as (supervisor, domain):
        rclpy.init(domain_id=domain)
        node = Node("asker")
        expected = {(name, f"/{name}_space") for name in NODES}

        def all_there() -> bool:
            supervisor.check(set(NODES))
            return expected <= set(node.get_node_names_and_namespaces())

        wait_until(all_there, 90.0)
        yield node
        node.destroy_node()
        rclpy.try_shutdown()


def qos_of(infos: list[Any], node: str) -> str:
    profile = next(info.qos_profile for info in infos if info.node_name == node)
    words = ["reliable" if profile.reliability == ReliabilityPolicy.RELIABLE else "best effort"]
    if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        words.append("transient local")
    return ", ".join(words)


def interfaces_of(asker: Any, node: str) -> set[tuple[str, ...]]:
    """List (kind, relative name, type, reliability and durability); Fast DDS does not report the depth."""
    space = f"/{node}_space"
    found: set[tuple[str, ...]] = set()

    def relative(name: str) -> str:
        return name.removeprefix(f"{space}/")

    for kind, topics, infos in (
        ("publishes", asker.get_publisher_names_and_types_by_node, asker.get_publishers_info_by_topic),
        ("subscribes", asker.get_subscriber_names_and_types_by_node, asker.get_subscriptions_info_by_topic),
    ):
        for name, (type_name,) in topics(node, space):
            if name not in EVERY_NODE and "/_action/" not in name:
                found.add((kind, relative(name), type_name.replace("/msg/", "/"), qos_of(infos(name), node)))
    for kind, services in (
        ("serves", asker.get_service_names_and_types_by_node),
        ("calls", asker.get_client_names_and_types_by_node),
    ):
        for name, (type_name,) in services(node, space):
            if name.endswith("/_action/send_goal"):
                action = name.removesuffix("/_action/send_goal")
                found.add(
                    ("action", relative(action), type_name.replace("/action/", "/").removesuffix("_SendGoal"), "")
                )
            elif f"/{node}/" not in name and "/_action/" not in name and "get_type_description" not in name:
                found.add((kind, relative(name), type_name.replace("/srv/", "/"), ""))
    return found


@pytest.mark.parametrize("node", NODES)
def test_the_document_lists_every_interface_and_no_other(graph: Any, node: str) -> None:
    rows = tables(node)[0] | set(DIAGNOSTICS.findall(DOCUMENT.read_text()))
    written = {(row[0], row[1], row[2], row[3].rpartition(", ")[0]) for row in rows}
    assert len(written) > 1
    optional = OPTIONAL.get(node, set())
    required = {row for row in written if row[:2] not in optional}
    deadline = time.monotonic() + 30.0
    while not required <= (found := interfaces_of(graph, node)) and time.monotonic() < deadline:
        time.sleep(0.1)  # endpoints are announced after their node
    assert required <= found, required - found
    assert found <= written, found - written


@pytest.mark.parametrize("node", NODES)
def test_a_running_node_describes_its_parameters_as_the_document_does(graph: Any, node: str) -> None:
    """What `ros2 param describe` shows: type, range, and a sentence; and none can be changed in a running node."""

    def ask(service: Any, name: str, request: Any) -> Any:
        client = graph.create_client(service, f"/{node}_space/{node}/{name}")
        assert client.wait_for_service(20.0)
        future = client.call_async(request)
        rclpy.spin_until_future_complete(graph, future, timeout_sec=20.0)
        assert future.result() is not None
        return future.result()

    names = ask(ListParameters, "list_parameters", ListParameters.Request()).result.names
    names = sorted(n for n in names if n not in ("use_sim_time", "start_type_description_service"))
    descriptors = ask(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names)).descriptors
    ranges = [re.sub("^(a number from|one of) ", "", d.additional_constraints) for d in descriptors]
    meanings = [re.sub(", one for each namespace; -1.*", "", d.description) for d in descriptors]
    described = {(d.name, TYPES[d.type], *rest) for d, *rest in zip(descriptors, ranges, meanings, strict=True)}
    assert described == {(row[0], row[1], row[3], row[4]) for row in tables(node)[1]}
    assert all(d.read_only and d.description for d in descriptors)
    for d in descriptors:
        if d.additional_constraints.startswith("a number from") and d.type in (2, 3):
            bounds = (list(d.integer_range) + list(d.floating_point_range))[0]
            assert f"a number from {bounds.from_value:g} to {bounds.to_value:g}" == d.additional_constraints
    values = ask(GetParameters, "get_parameters", GetParameters.Request(names=names)).values
    given = NODES[node][1]
    for row in tables(node)[1]:
        if row[0] not in given:
            assert shown(values[names.index(row[0])]) == row[2], row[0]
    other = Parameter(name=names[0], value=ParameterValue(type=4, string_value="x"))
    (answer,) = ask(SetParameters, "set_parameters", SetParameters.Request(parameters=[other])).results
    assert not answer.successful and "read-only" in answer.reason


def shown(value: Any) -> str:
    """Format a parameter's value as the document does."""
    found = parameter_value_to_python(value)
    if isinstance(found, bool):
        return str(found).lower()
    if not isinstance(found, (int, float, str)):
        return "[" + ", ".join('""' if v == "" else f"{v:g}" for v in found) + "]"
    return f"{found:g}" if isinstance(found, float) else str(found)


POINTS = [(125.0 + 8.0 * (i % 2), 25.0 * i) for i in range(9)]
ROADS = {
    "plain": Road(POINTS),
    "narrow": Road(POINTS, lane_width=3.5),
    "maxitwo": Road(POINTS, maxitwo_compatible=True),
    "sampled": Road.from_road_points(Road(POINTS).points, lane_width=3.0),
    "left": Road(POINTS, lane="left"),
    "middle": Road(POINTS, lane="middle"),
    "single": Road.from_road_points(Road(POINTS).points, lane_width=2.5, lane="single"),
}


@pytest.mark.parametrize("name", ROADS)
def test_a_road_message_makes_an_equal_road_with_the_same_id(name: str) -> None:
    sent = deserialize_message(serialize_message(road_to_message(ROADS[name])), RoadMsg)
    made = road_from_message(sent)
    assert made == ROADS[name] and made.road_id == ROADS[name].road_id == sent.road_id
    np.testing.assert_array_equal(made.points, ROADS[name].points)


def test_a_road_message_without_a_width_has_the_usual_one_and_contradictions_are_refused() -> None:
    message = road_to_message(ROADS["plain"])
    message.lane_width = 0.0
    assert road_from_message(message) == ROADS["plain"]
    message.sampled = message.maxitwo_compatible = True
    with pytest.raises(RoadError, match="both sampled and maxitwo_compatible"):
        road_from_message(message)


def test_the_numbers_of_outcomes_and_reasons_are_those_of_the_messages() -> None:
    for kind, message in ((Outcome, OutcomeMsg), (Reason, ReasonMsg)):
        constants = {name: getattr(message, name) for name in vars(type(message)).get("_Metaclass_Constants", [])}
        constants = constants or {name: getattr(message, name) for name in kind.__members__}
        assert constants == {member.name: int(member) for member in kind}


def test_odometry_is_marked_as_ground_truth() -> None:
    """Tiny variances for exact values, huge ones for missing values; zeros would mean unknown."""
    vehicle = VehicleState(x=1.0, y=2.0, yaw=0.5, speed=3.0, yaw_rate=0.1, steering_angle=0.0)
    make = message_builder("/ds1")
    message = make.odometry(vehicle, make.stamp(0))
    assert (message.header.frame_id, message.child_frame_id) == ("road", "ds1/base_link")
    for covariance in (message.pose.covariance, message.twist.covariance):
        matrix = np.reshape(covariance, (6, 6))
        assert np.all(np.linalg.eigvalsh(matrix) > 0.0)
        assert np.all(np.diag(matrix)[[0, 1, 5]] < 1e-6) and np.all(np.diag(matrix)[[2, 3, 4]] > 1e6)
