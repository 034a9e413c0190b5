# SPDX-License-Identifier: Apache-2.0
"""A driver node that translates the images of its simulator: the bits of a drive in this process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from sensor_msgs.msg import Image
from tests.graph.processes import SPACE
from tests.waiting import wait_until

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.networks.driver_name import DriverName
from ds_driver.sim2real.generator import GeneratorShape, Window, load_generator, save_generator
from ds_driver.sim2real.image_translation import Translator
from ds_driver.sim2real.networks import Generator
from ds_orchestrator.campaign.executor import trajectory_sha256
from ds_orchestrator.graph.session import running_graph
from ds_road import Road
from ds_sim.registry import DONKEY, make_simulator
from ds_sim.ros.conversions import pixels_of
from ds_sim.ros.node_thread import NodeThread
from ds_sim.scenario import Scenario

pytestmark = pytest.mark.graph

STRAIGHT = Road([(125.0, 25.0 * i) for i in range(1, 6)])


def test_a_node_drives_with_the_bits_of_this_process_and_publishes_what_it_sees(tmp_path: Path) -> None:
    shape, window = GeneratorShape(filters=2, blocks=1, rows=32, columns=64), Window(60, 160, 0, 320)
    torch.manual_seed(1)
    tensors = {name: value.numpy() for name, value in Generator(shape).state_dict().items()}
    path = tmp_path / "set" / "donkey.safetensors"
    path.parent.mkdir()
    save_generator(path, tensors, simulator="donkey", shape=shape, window=window, real_window=window)
    driver = DriverName("dave2_short", str(path.parent))
    simulator = make_simulator("donkey")
    here = drive_road(simulator, make_driver(driver, simulator.spec), STRAIGHT, 1)
    first = simulator.load(STRAIGHT, seed=1).image
    simulator.close()
    with running_graph(SPACE, driver, command_timeout=10.0, logs=tmp_path, draw="seen") as executor:
        node = Node("viewer", context=executor.context)
        images: list[Any] = []
        node.create_subscription(Image, "/ds1/sim2real/image_raw", images.append, 1000)
        viewer = NodeThread(node)
        # The driver has discovered the subscription once it answers a client that was made after it.
        client = node.create_client(GetParameters, "/ds1/driver/get_parameters")
        assert viewer.ask(client, GetParameters.Request(names=["use_sim_time"]), 20.0)
        there = executor.execute(DONKEY, Scenario(STRAIGHT, seed=1))
        wait_until(lambda: len(images) >= len(there.commands))
        assert viewer.end()
        node.destroy_node()
    assert trajectory_sha256(there) == trajectory_sha256(here) and len(here.commands) > 20
    assert np.array_equal(pixels_of(images[0]), Translator(load_generator(path)).translate(first))
