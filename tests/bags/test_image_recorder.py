# SPDX-License-Identifier: Apache-2.0
"""Images recorded from the graph of a user-defined simulator equal those that its driver received."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.context import Context
from rclpy.node import Node

from ds_bags.messages import message_builder, typestore
from ds_bags.reader import STATE
from ds_bags.ros.image_recorder import ImageRecorder, with_images
from ds_bags.rosbag2_writer import Rosbag2Writer, topic_of
from ds_bags.verification import IMAGE, verify_bag
from ds_base.processes import ChildProcesses
from ds_orchestrator.graph.session import RosDomain
from ds_road import Road
from ds_sim.registry import DONKEY
from ds_sim.resimulation import resimulate
from ds_sim.ros.runtime import init_ros
from ds_sim.session import RunRecord

pytestmark = pytest.mark.graph


def test_a_subscribed_bag_has_every_image_bit_by_bit(tmp_path: Path) -> None:
    """The twin under its class's name is not in the registry, so it is recorded instead of re-simulated."""
    road = Road([(125.0, 25.0 * i) for i in range(4)])
    (tmp_path / "road.json").write_text(json.dumps(road.control_points))
    bag = tmp_path / "bag"
    command = [
        sys.executable,
        "-m",
        "ds_cli.main",
        "drive",
        "--sim",
        "ds_twin_donkey.simulator:DonkeySimulator",
        "--driver",
        "autopilot",
        "--road",
        str(tmp_path / "road.json"),
        "--bag",
        str(bag),
        "--level",
        "raw",
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    steps = json.loads(done.stdout)["steps"]
    found = verify_bag(bag)
    assert (found.step, found.frames, found.images) == (None, steps + 1, steps + 1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "road.json"]


@pytest.mark.parametrize("lost", [0, 1, 7])
def test_a_lost_state_costs_no_image_and_a_lost_image_only_itself(run: RunRecord, tmp_path: Path, lost: int) -> None:
    """A node's stamps begin anywhere, and floats are rounded: the recording is shifted by no whole nanosecond."""
    start = 86_400.123456789012
    make, writer = message_builder("/ds1"), Rosbag2Writer(tmp_path / "spool", {})

    def encode(message: Any) -> bytes:
        return bytes(typestore().serialize_cdr(message, message.__msgtype__))

    states = writer.channel(topic_of(typestore(), "/ds1/state", STATE, depth=50))
    images = writer.channel(topic_of(typestore(), "/ds1/camera/image_raw", IMAGE, depth=50))
    seen = list(resimulate(DONKEY, run))
    for frame in seen:
        stamp = round((start + frame.time) * 1e9)
        if frame.step != lost:
            writer.write(states, stamp, encode(make.state(frame, make.header(stamp, "road"), run.road.road_id)))
        if frame.step != lost + 1:
            writer.write(images, stamp, encode(make.image(frame.image, make.header(stamp, "ds1/camera"))))
    writer.close({})
    found = list(with_images(run, tmp_path / "spool"))
    assert [frame.step for frame in found if not frame.image.size] == [lost + 1]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(found, seen, strict=True) if a.image.size)


SIMULATOR = """
import rclpy
from ds_interfaces.msg import VehicleState
from ds_interfaces.srv import GetSimulatorInfo
from rclpy.node import Node
from sensor_msgs.msg import Image
rclpy.init()
node = Node("simulator", namespace="/ds1")
kept = node.create_publisher(Image, "camera/image_raw", 600), node.create_publisher(VehicleState, "state", 50)
node.create_service(GetSimulatorInfo, "get_info", lambda _, answer: answer)
rclpy.spin(node)
"""


def test_a_recorder_waits_until_the_simulator_has_heard_of_it(tmp_path: Path) -> None:
    """A stopped process is in the ROS graph as before, and publishes nothing to a subscriber that it has not met."""
    domain, context = RosDomain(), Context()
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain.number)}
    children = ChildProcesses()
    simulator = children.start([sys.executable, "-c", SIMULATOR], environment=environment, log=tmp_path / "log")
    init_ros(context=context, domain_id=domain.number)
    node = Node("observer", context=context)
    try:
        deadline = time.monotonic() + 60.0
        while not node.count_publishers("/ds1/camera/image_raw"):
            assert simulator.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        simulator.send_signal(signal.SIGSTOP)
        with ImageRecorder(tmp_path / "bag", "/ds1", {}, context) as recorder:
            assert not recorder.wait_for_simulator(1.0)
            simulator.send_signal(signal.SIGCONT)
            assert recorder.wait_for_simulator()
    finally:
        simulator.kill()
        simulator.wait()
        children.close()
        node.destroy_node()
        context.shutdown()
        domain.close()
