# SPDX-License-Identifier: Apache-2.0
"""Drivers with standard messages drive a simulator through the adapter, in lock-step and in real time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.graph.processes import SPACE, driven_graph, simulator_processes

from ds_orchestrator.graph.supervisor import ProcessSpec
from ds_road import Road
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
    from geometry_msgs.msg import TwistStamped
    from rclpy.node import Node
    from sensor_msgs.msg import Image

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
    from geometry_msgs.msg import Twist
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data

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
