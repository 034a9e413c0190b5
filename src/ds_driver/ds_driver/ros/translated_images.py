"""Translates the images of a driver's simulators, and publishes them on `sim2real/image_raw` for whoever subscribes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from ds_interfaces.msg import Frame
from ds_interfaces.srv import GetSimulatorInfo
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image

from ds_driver.networks.pilot import DriverError
from ds_driver.ros.simulator_client import Answer, SimulatorClient
from ds_driver.ros.simulator_info import SimulatorInfo
from ds_driver.sim2real.stage import Sim2RealStage
from ds_sim.ros.conversions import pixels_to_message

TOPIC = "sim2real/image_raw"


class TranslatedImages:
    """Asks each simulator for its name before a run, which selects the generator.

    Args:
        node: node that owns clients and publishers.
        namespaces: namespaces of the simulators; "" for the node's own.
        stage: translates.
    """

    def __init__(self, node: Node, namespaces: Sequence[str], stage: Sim2RealStage) -> None:
        self._node = node
        self._namespaces = namespaces
        self._stage = stage
        self._info = SimulatorInfo(node, namespaces, "which selects the sim2real generator", self._on_info)
        self._names: list[str | None] = [None] * len(namespaces)
        self._answers: dict[int, Answer] = {}
        self._clients: dict[int, SimulatorClient] = {}
        self._publishers = [
            node.create_publisher(Image, f"{name}/{TOPIC}" if name else TOPIC, 5) for name in namespaces
        ]

    def connect(self, index: int, answer: Answer) -> None:
        """Answer the frames of a simulator as soon as its name is known."""
        self._answers[index] = answer
        self._clients[index] = SimulatorClient(
            self._node, self._namespaces[index], Frame, partial(self._info.ask, index)
        )
        self._info.ask(index)

    def translate(self, index: int, frame: Frame, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Translate the image of a frame, and publish the result if somebody subscribes.

        Raises:
            DriverError: there is no generator for the simulator.
        """
        name = self._names[index]
        if name is None:
            raise DriverError("the simulator has not stated its name yet")
        translated = self._stage.translate(image, name)
        publisher = self._publishers[index]
        if publisher.get_subscription_count():
            publisher.publish(pixels_to_message(translated, frame.header))
        return translated

    def _on_info(self, index: int, info: GetSimulatorInfo.Response) -> None:
        if info.name != self._names[index]:
            namespace = self._namespaces[index] or self._node.get_namespace()
            try:
                digest = self._stage.generators.generator(info.name).sha256[:12]
                self._node.get_logger().info(f"{namespace}: generator {digest} translates images of {info.name}")
            except DriverError as error:  # every frame will state it, too
                self._node.get_logger().error(str(error))
        self._names[index] = info.name
        self._clients[index].drive_with(self._answers[index])
