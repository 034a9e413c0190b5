# SPDX-License-Identifier: Apache-2.0
"""Contract of every simulator's node: the same bits as without ROS, signs of REP-103, correct information."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ds_interfaces.msg import VehicleState
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from tests.drives import driven
from tests.graph.processes import watched_run

from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.executor import trajectory_sha256
from ds_orchestrator.graph.session import running_graph
from ds_road import Road
from ds_sim.registry import SimulatorName, spec_of
from ds_sim.scenario import Scenario
from ds_sim.simulator import FRAME_TIME, Outcome

pytestmark = pytest.mark.graph

ROAD = Road([(120.0, 30.0), (120.0, 55.0), (126.0, 79.0), (142.0, 98.0), (165.0, 107.0)])
"""Road of 50 m that ends in a right turn of 45 degrees."""


@pytest.fixture(scope="module")
def graph(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Every simulator with the autopilot, in one graph; yields (executor, simulator -> namespace)."""
    names = request.getfixturevalue("all_simulator_names")
    spaces = {name: f"/sim{index}" for index, name in enumerate(names)}
    logs: Path = tmp_path_factory.mktemp("logs")
    with running_graph(spaces, AUTOPILOT, command_timeout=10.0, logs=logs) as executor:
        yield executor, spaces


def test_a_node_drives_as_its_simulator_does(graph: Any, simulator_name: str) -> None:
    """Bit for bit, and again after another road."""
    executor, _ = graph
    here = driven(simulator_name, ROAD, 5)
    assert here.outcome is Outcome.COMPLETED
    scenarios = [Scenario(road, seed=seed) for road, seed in ((ROAD, 5), (ROAD.reversed(), 6), (ROAD, 5))]
    runs = [executor.execute(simulator_name, scenario) for scenario in scenarios]
    assert [run.outcome for run in runs] == [Outcome.COMPLETED] * 3
    assert [trajectory_sha256(run) == trajectory_sha256(here) for run in runs] == [True, False, True]
    assert runs[0].commands == here.commands
    assert runs[0].fitness == here.fitness


def test_a_node_describes_its_simulator(graph: Any, simulator_name: str) -> None:
    executor, _ = graph
    spec, info = spec_of(simulator_name), executor.info(simulator_name)
    assert (info.name, info.physics) == (spec.name, spec.physics)
    assert info.wheelbase == pytest.approx(spec.wheelbase)
    assert info.max_steering_angle == pytest.approx(spec.max_steering_angle)


def test_topics_keep_rep_103_and_105(graph: Any, simulator_name: str) -> None:
    """Odometry turns left where the road does, frames carry the namespace, images and info belong together."""
    executor, spaces = graph
    space = spaces[simulator_name]
    topics = {
        f"{space}/odom": Odometry,
        f"{space}/camera/camera_info": CameraInfo,
        f"{space}/camera/image_raw": Image,
        f"{space}/camera/image_raw/compressed": CompressedImage,
        f"{space}/state": VehicleState,
    }
    scenario = Scenario(ROAD, seed=5)
    run, heard = watched_run(executor, SimulatorName(simulator_name), scenario, f"{space}/simulator", topics)
    assert run.outcome is Outcome.COMPLETED
    assert [len(messages) for messages in heard.values()] == [run.steps + 1] * 5
    odoms, infos, images, jpegs, states = heard.values()
    odom, info, image, jpeg, state = (messages[-1] for messages in heard.values())
    name = space.strip("/")
    assert odom.child_frame_id == f"{name}/base_link"
    assert odom.header.frame_id == state.header.frame_id == "road"
    assert (image.height, image.width, image.encoding, image.step) == (160, 320, "rgb8", 960)
    assert image.header.frame_id == f"{name}/camera_optical"
    assert [image.header.stamp for image in images] == [info.header.stamp for info in infos]
    assert {message.header.frame_id for message in [*infos, *jpegs]} == {image.header.frame_id}
    assert jpeg.header.stamp == image.header.stamp == state.header.stamp
    seen = np.frombuffer(image.data, np.uint8).reshape(160, 320, 3)
    decoded = cv2.imdecode(np.array(jpeg.data), cv2.IMREAD_COLOR)
    assert decoded is not None and cv2.PSNR(decoded[..., ::-1], seen) > 30.0
    camera = spec_of(simulator_name).camera
    assert (info.height, info.width) == (160, 320)
    assert np.reshape(info.k, (3, 3)) == pytest.approx(camera.intrinsics)
    # The number of coefficients that OpenCV and image_proc expect of each model.
    assert info.distortion_model in ("plumb_bob", "rational_polynomial")
    assert len(info.d) == {"plumb_bob": 5, "rational_polynomial": 8}[info.distortion_model]
    assert list(info.d[: len(camera.distortion)]) == pytest.approx(list(camera.distortion))
    # Against the recorded run, in its order: equal x and y, yaw rate positive to the left, quaternion of the heading.
    recorded = iter(observation.vehicle for observation in run.observations)
    for message in odoms:
        place, q = message.pose.pose.position, message.pose.pose.orientation
        here = pytest.approx((place.x, place.y), abs=1e-9)
        vehicle = next((one for one in recorded if (one.x, one.y) == here), None)
        assert vehicle is not None
        yaw = np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        assert np.cos(yaw - vehicle.yaw) == pytest.approx(1.0, abs=1e-4)
        assert message.twist.twist.linear.x == pytest.approx(vehicle.speed, abs=1e-6)
        assert message.twist.twist.angular.z == pytest.approx(vehicle.yaw_rate, abs=1e-6)
    turned = run.observations[-1].vehicle.yaw - run.observations[0].vehicle.yaw
    summed = sum(observation.vehicle.yaw_rate for observation in run.observations) * FRAME_TIME
    assert summed == pytest.approx(turned, abs=0.05)
