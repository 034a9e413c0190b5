"""Connects a driver to one simulator: pairs each image with the state of its step, and publishes commands."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Time
from ds_interfaces.msg import DriveCommand, VehicleState
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from ds_driver.networks.pilot import DriverError
from ds_driver.networks.preprocessing import ImageError
from ds_sim.simulator import Command

Answer = Callable[[NDArray[np.uint8], VehicleState], Command]
"""Maps an image, (rows, columns, 3) uint8 RGB, and the state of the same step to a command."""

LOCKSTEP_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class SimulatorClient:
    """Subscribes to the camera and the state of one simulator and publishes the answer to each frame.

    Its topics appear in the ROS graph with the first call of `drive_with`, when it can answer.

    Args:
        node: node that owns the subscriptions.
        namespace: namespace of the simulator; "" for the node's own.
        on_start: called at the first frame of each run, which then waits for `drive_with`; None to answer all runs
            alike.
    """

    def __init__(self, node: Node, namespace: str, on_start: Callable[[], None] | None = None) -> None:
        self._node = node
        self._prefix = f"{namespace}/" if namespace else ""
        self._on_start = on_start
        self._answer: Answer | None = None
        self._drive: Publisher | None = None
        self._image: Image | None = None
        self._state: VehicleState | None = None
        self._start: Time | None = None

    def drive_with(self, answer: Answer) -> None:
        """Answer frames from now on, including one that is waiting.

        Args:
            answer: called once per frame. A ValueError leaves the frame unanswered and is logged in one line. After a
                DriverError, which would recur with every frame, an invalid command is published, so that the result
                of the run states the cause.
        """
        self._answer = answer
        if self._drive is None:
            self._drive = self._node.create_publisher(DriveCommand, f"{self._prefix}drive", 1)
            self._node.create_subscription(Image, f"{self._prefix}camera/image_raw", self._on_image, LOCKSTEP_QOS)
            self._node.create_subscription(VehicleState, f"{self._prefix}state", self._on_state, 5)
        self._answer_if_complete()

    def _on_image(self, image: Image) -> None:
        self._image = image
        self._answer_if_complete()

    def _on_state(self, state: VehicleState) -> None:
        self._state = state
        if state.step == 0 and self._on_start is not None and state.header.stamp != self._start:
            self._start, self._answer = state.header.stamp, None
            self._on_start()
        self._answer_if_complete()

    def _answer_if_complete(self) -> None:
        image, state, drive = self._image, self._state, self._drive
        if image is None or state is None or drive is None or image.header.stamp != state.header.stamp:
            return
        if self._answer is None:
            return
        self._image = None
        try:
            command = self._answer(_pixels(image), state)
        except ValueError as error:
            self._node.get_logger().error(f"frame not answered: {error}", throttle_duration_sec=1.0)
            if isinstance(error, DriverError):
                drive.publish(DriveCommand(header=image.header, steering=math.nan, throttle=0.0))
            return
        drive.publish(DriveCommand(header=image.header, steering=command.steering, throttle=command.throttle))


def _pixels(image: Image) -> NDArray[np.uint8]:
    if image.encoding != "rgb8" or len(image.data) != image.height * image.width * 3:
        raise ImageError(
            f"image of encoding {image.encoding!r}, {image.width} x {image.height} px and {len(image.data)} bytes, "
            "expected rgb8 with three bytes a pixel"
        )
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
