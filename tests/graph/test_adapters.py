# SPDX-License-Identifier: Apache-2.0
"""Drivers in other ROS stacks: standard messages through the adapter, and the camera driver on any camera.

The adapter works in lock-step and in real time; the camera driver has remapped topics, and reports its latency.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
from tests.graph.processes import SPACE, driven_graph, simulator_processes, supervised
from tests.waiting import wait_until

from ds_driver.control.bicycle import Geometry
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import Frame
from ds_orchestrator.graph.supervisor import ProcessSpec
from ds_road import Road
from ds_sim.registry import make_simulator
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome, Reason

pytestmark = pytest.mark.graph

STRAIGHT = Road([(125.0, 15.0 * i) for i in range(1, 6)])


@pytest.fixture
def adapted(logs: Path, request: pytest.FixtureRequest, join: Callable[[int], None]) -> Iterator[Any]:
    """A donkey, and the adapter with the parameters of the test."""
    sync, parameters = request.param
    module = "ds_driver.ros.cmd_vel_adapter_node"
    adapter = ProcessSpec(name="driver", module=module, namespace="/ds1", parameters=parameters)
    with driven_graph([*simulator_processes(SPACE, 10.0, sync=sync), adapter], logs) as (executor, domain):
        join(domain)
        yield executor


@pytest.mark.parametrize("adapted", [("lockstep", {})], indirect=True)
def test_a_stamped_twist_drives_to_the_end_at_the_speed_it_asks_for(adapted: Any, spin: Callable[..., None]) -> None:
    """It copies the image's header, and sees the requested speed; turning left, it leaves the lane on the left."""
    node = Node("standard_driver")
    publisher = node.create_publisher(TwistStamped, "/ds1/cmd_vel", 1)
    speed, turn = [4.0], [0.0]

    def answer(image: Image) -> None:
        message = TwistStamped(header=image.header)
        message.twist.linear.x, message.twist.angular.z = speed[0], turn[0]
        publisher.publish(message)

    node.create_subscription(Image, "/ds1/camera/image_raw", answer, 1)
    spin(node)
    straight = adapted.execute("donkey", Scenario(STRAIGHT, seed=1))
    assert straight.outcome is Outcome.COMPLETED, straight.message
    assert straight.observations[-1].vehicle.speed == pytest.approx(4.0, abs=0.5)
    turn[0] = 0.5
    left = adapted.execute("donkey", Scenario(STRAIGHT, seed=1))
    assert left.outcome is Outcome.OUT_OF_BOUNDS
    assert left.observations[-1].lane.lateral_position < -2.0
    assert left.observations[-1].vehicle.yaw_rate > 0.0
    adapted._timeout = 2.0
    backing_up = (-0.05, 0.0, "speed is -0.05: the vehicles here have no reverse gear")  # as Nav2's BackUp
    for speed[0], turn[0], reason in ((4.0, math.nan, "twist.angular.z is nan"), backing_up):
        broken = adapted.execute("donkey", Scenario(STRAIGHT, seed=1))
        assert (broken.outcome, broken.reason) == (Outcome.DRIVER_SILENT, Reason.COMMAND_REFUSED)
        assert f"the last command was refused: {reason}" in broken.message
    node.destroy_node()


@pytest.mark.parametrize("adapted", [("realtime", {"message": "twist"})], indirect=True)
def test_a_twist_without_stamp_drives_in_real_time_and_silence_ends_it(adapted: Any, spin: Callable[..., None]) -> None:
    """The result's message states the jitter; the watchdog ends a run whose driver stops sending."""
    node = Node("standard_driver")
    publisher = node.create_publisher(Twist, "/ds1/cmd_vel", qos_profile_sensor_data)  # best effort
    message = Twist()
    message.linear.x = 6.0
    timer = node.create_timer(0.05, lambda: publisher.publish(message))
    spin(node)
    run = adapted.execute("donkey", Scenario(STRAIGHT, seed=1))
    assert run.outcome is Outcome.COMPLETED, run.message
    assert f"real time: {run.steps} frames at 20 Hz" in run.message and "ms in the median" in run.message
    timer.cancel()
    adapted._timeout = 1.0
    silent = adapted.execute("donkey", Scenario(STRAIGHT, seed=1))
    assert silent.outcome is Outcome.DRIVER_SILENT and "no command within 1 s" in silent.message
    node.destroy_node()


def test_the_same_picture_in_any_encoding_and_size_is_driven_alike(
    logs: Path, join: Callable[[int], None], spin: Callable[..., None]
) -> None:
    bend = Road([(50, 30), (50, 60), (60, 85), (85, 100), (110, 105), (140, 105)])
    rgb = np.asarray(make_simulator("bullet").load(bend, seed=1).image)
    pictures = {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "mono8": cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
        "yuv422": cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_UYVY),
        "yuv422_yuy2": cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_YUY2),
        "rgb8 large": cv2.resize(rgb, (640, 320), interpolation=cv2.INTER_NEAREST),
        "32FC1": np.zeros((160, 320, 4), np.uint8),
    }
    # Expected commands, from the network in this process: the speed of equation 2, the bicycle model's yaw rate.
    steering = NetworkDriver("dave2").command(replace(Frame.black(), image=rgb)).steering
    speed = 2.0 * (1.0 - steering**2) ** 0.5
    yaw_rate = Geometry(0.3, 0.4).yaw_rate_of(speed, -0.4 * steering)

    car = {"wheelbase": 0.3, "max_steering_angle": 0.4, "max_speed": 2.0}
    spec = ProcessSpec(
        name="driver",
        module="ds_driver.ros.camera_driver_node",
        namespace="/car",
        parameters={"output": "twist_stamped", "speed_from": "none", **car},
        remappings={"camera/image_raw": "/front/image", "cmd_vel": "/mux/cmd_vel"},
    )
    with supervised([spec], logs) as (_, domain):
        join(domain)
        node = Node("car")
        camera = node.create_publisher(Image, "/front/image", qos_profile_sensor_data)  # best effort, as cameras are
        heard: list[TwistStamped] = []
        told: list[DiagnosticArray] = []
        node.create_subscription(TwistStamped, "/mux/cmd_vel", heard.append, 10)
        node.create_subscription(DiagnosticArray, "/diagnostics", told.append, 10)
        spin(node)
        wait_until(lambda: camera.get_subscription_count() and node.count_publishers("/mux/cmd_vel"))
        answers: dict[str, TwistStamped] = {}
        for second, (name, pixels) in enumerate(pictures.items(), start=1):
            rows, columns = pixels.shape[:2]
            image = Image(height=rows, width=columns, encoding=name.split()[0])
            image.data = np.ascontiguousarray(pixels).tobytes()
            image.step = len(image.data) // rows
            image.header.stamp.sec = second
            for _ in range(30 if name != "32FC1" else 3):
                camera.publish(image)
                time.sleep(0.1)
                if found := [m for m in heard if m.header.stamp.sec == second]:
                    answers[name] = found[-1]
                    break
        assert set(answers) == set(pictures) - {"32FC1"}
        rates = {name: message.twist.angular.z for name, message in answers.items()}
        assert rates["rgb8"] == pytest.approx(yaw_rate, abs=1e-6)
        assert answers["rgb8"].twist.linear.x == pytest.approx(speed, abs=1e-6)
        assert rates["bgr8"] == rates["rgb8"] == rates["rgb8 large"]
        assert rates["yuv422"] == rates["yuv422_yuy2"]  # the same values in another order
        assert rates["yuv422"] == pytest.approx(rates["rgb8"], abs=0.15)
        assert np.isfinite(rates["mono8"])
        wait_until(lambda: any(a.status[0].level == b"\x02" for a in told))
        status = told[-1].status[0]
        values = {v.key: v.value for v in status.values}
        assert status.hardware_id == "/car/camera_driver"
        assert int(values["frames answered"]) >= 6 and int(values["frames refused"]) >= 1
        assert 0.0 < float(values["latency mean ms"]) <= float(values["latency max ms"])
        assert "image of encoding '32FC1'" in (logs / "driver.log").read_text()
        node.destroy_node()
