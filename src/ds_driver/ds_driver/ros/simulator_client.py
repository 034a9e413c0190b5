"""One simulator as a driver sees it: pairs each image with the state of the same step, and sends commands back."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from ds_interfaces.msg import DriveCommand, VehicleState
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from ds_driver.networks.pilot import DriverError
from ds_driver.networks.preprocessing import ImageError
from ds_sim.simulator import Command

Answer = Callable[[NDArray[np.uint8], VehicleState], Command]
"""From an image (rows, columns, 3) uint8 RGB and the state of the same step to a command."""

LOCKSTEP_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class SimulatorClient:
    """Subscribes to the camera and the state of one simulator and publishes the answer to each frame.

    Args:
        node: that owns the subscriptions.
        namespace: of the simulator; "" for topics relative to the node's own.
        answer: called once per frame. A ValueError leaves the frame unanswered and is told in one line. At a
            DriverError, too, which no later frame mends, a command that no simulator executes says so in the run.
    """

    def __init__(self, node: Node, namespace: str, answer: Answer) -> None:
        self._node = node
        self._answer = answer
        self._image: Image | None = None
        self._state: VehicleState | None = None
        prefix = f"{namespace}/" if namespace else ""
        node.create_subscription(Image, f"{prefix}camera/image_raw", self._on_image, LOCKSTEP_QOS)
        node.create_subscription(VehicleState, f"{prefix}state", self._on_state, 5)
        self._drive = node.create_publisher(DriveCommand, f"{prefix}drive", 1)

    def _on_image(self, image: Image) -> None:
        self._image = image
        self._answer_if_complete()

    def _on_state(self, state: VehicleState) -> None:
        self._state = state
        self._answer_if_complete()

    def _answer_if_complete(self) -> None:
        image, state = self._image, self._state
        if image is None or state is None or image.header.stamp != state.header.stamp:
            return
        self._image = None
        try:
            command = self._answer(_pixels(image), state)
        except ValueError as error:
            self._node.get_logger().error(f"frame not answered: {error}", throttle_duration_sec=1.0)
            if isinstance(error, DriverError):
                self._drive.publish(DriveCommand(header=image.header, steering=math.nan, throttle=0.0))
            return
        self._drive.publish(DriveCommand(header=image.header, steering=command.steering, throttle=command.throttle))


def _pixels(image: Image) -> NDArray[np.uint8]:
    if image.encoding != "rgb8" or len(image.data) != image.height * image.width * 3:
        raise ImageError(
            f"image of encoding {image.encoding!r}, {image.width} x {image.height} px and {len(image.data)} bytes, "
            "expected rgb8 with three bytes a pixel"
        )
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
