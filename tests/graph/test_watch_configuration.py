# SPDX-License-Identifier: Apache-2.0
"""Foxglove's layout and RViz's configuration: every topic, type, field and frame is one that our nodes publish.

The two programs themselves are not here; what they read of a type is from their documentation.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from ds_interfaces.msg import VehicleState
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from tests.waiting import wait_until

from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.graph.session import RosDomain
from ds_sim.messages import ROAD_FRAME, frame_of
from ds_sim.registry import BULLET, DONKEY, SOFTBODY, spec_of
from ds_sim.ros.frame_publisher import FramePublisher

CONFIG = Path(__file__).resolve().parents[2] / "src/ds_bringup/config"
LAYOUT: dict[str, Any] = json.loads((CONFIG / "foxglove_layout.json").read_text())
RVIZ: dict[str, Any] = yaml.safe_load((CONFIG / "watch.rviz").read_text())["Visualization Manager"]
NAMESPACES = tuple(DriveSettings(siblings=(BULLET, SOFTBODY), twin=DONKEY, driver=AUTOPILOT).namespaces.values())
DISPLAYS = {
    "rviz_default_plugins/Image": "sensor_msgs/msg/Image",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
}
"""Display of RViz -> type that it subscribes to (rviz_default_plugins/plugins_description.xml)."""


@pytest.fixture(scope="module")
def published() -> Iterator[dict[str, tuple[str, Any]]]:
    """Topic -> type and QoS of what a simulator's node publishes in each namespace."""
    domain, context = RosDomain(), Context()
    rclpy.init(context=context, domain_id=domain.number)
    nodes = [Node("simulator", namespace=namespace, context=context) for namespace in NAMESPACES]
    found: dict[str, tuple[str, Any]] = {}
    for node in nodes:
        FramePublisher(node, spec_of("bullet"))
        space = node.get_namespace()
        for topic, (kind, *_) in wait_until(partial(node.get_publisher_names_and_types_by_node, "simulator", space)):
            found[topic] = (kind, node.get_publishers_info_by_topic(topic)[0].qos_profile)
    yield found
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown(context=context)
    domain.close()


def test_foxglove_shows_topics_that_are_published(published: dict[str, tuple[str, Any]]) -> None:
    fields = set(VehicleState.get_fields_and_field_types())
    frames = {frame_of(name, frame) for name in NAMESPACES for frame in ("base_link", "camera_optical")}
    seen: set[str] = set()
    for name, panel in LAYOUT["configById"].items():
        kind = name.partition("!")[0]
        if kind == "Image":
            image, calibration = panel["imageMode"]["imageTopic"], panel["imageMode"]["calibrationTopic"]
            assert published[image][0] == "sensor_msgs/msg/Image"
            assert published[calibration][0] == "sensor_msgs/msg/CameraInfo"
            seen |= {image, calibration}
        elif kind == "3D":
            assert panel["followTf"] == ROAD_FRAME
            assert {key.removeprefix("frame:") for key in panel["transforms"]} == frames
            for topic in panel["topics"]:
                assert published[topic][0] == "visualization_msgs/msg/MarkerArray"
                seen.add(topic)
        else:
            assert kind == "Plot"
            for path in panel["paths"]:
                topic, _, field = path["value"].partition(".")
                if topic.startswith("/"):
                    assert published[topic][0] == "ds_interfaces/msg/VehicleState" and field in fields
                    seen.add(topic)
                else:
                    assert float(topic) == 0.0  # a line for reference
    assert {topic.split("/")[1] for topic in seen} == {name.strip("/") for name in NAMESPACES}
    assert len(seen) == 4 * len(NAMESPACES)


def test_rviz_subscribes_to_what_is_published(published: dict[str, tuple[str, Any]]) -> None:
    assert RVIZ["Global Options"]["Fixed Frame"] == ROAD_FRAME
    groups = {display["Name"]: display for display in RVIZ["Displays"] if display["Class"] == "rviz_common/Group"}
    assert {f"/{name}" for name in groups} == {f"/{name.strip('/')}" for name in NAMESPACES}
    for name, group in groups.items():
        assert {display["Class"] for display in group["Displays"]} == set(DISPLAYS)
        for display in group["Displays"]:
            wanted = display["Topic"]
            assert wanted["Value"].startswith(f"/{name}/")
            kind, qos = published[wanted["Value"]]
            assert kind == DISPLAYS[display["Class"]]
            # A subscription gets nothing from a publisher that offers less than it asks for.
            offers = {DurabilityPolicy.TRANSIENT_LOCAL: "Transient Local", DurabilityPolicy.VOLATILE: "Volatile"}
            assert wanted["Durability Policy"] in ("Volatile", offers[qos.durability])
            assert qos.reliability is ReliabilityPolicy.RELIABLE and wanted["Reliability Policy"] == "Reliable"
            if "road_markers" in wanted["Value"]:
                assert wanted["Durability Policy"] == "Transient Local"  # a road is published once
