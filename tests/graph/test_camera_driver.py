# SPDX-License-Identifier: Apache-2.0
"""The camera driver in another ROS stack: remapped topics, any camera, a chosen message type, reported latency."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
from tests.graph.processes import supervised
from tests.waiting import wait_until

from ds_driver.control.bicycle import Geometry
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import Frame
from ds_orchestrator.graph.supervisor import ProcessSpec
from ds_road import Road
from ds_sim.registry import make_simulator

pytestmark = pytest.mark.graph


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
