"""Feeds a driver with the images of any camera, in any encoding and size, and the speed of the odometry."""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from ds_driver.networks.images import fit_to_network, rgb_of, rgb_of_file
from ds_driver.ros.command_publisher import CommandOutput
from ds_driver.ros.latency_diagnostics import LatencyDiagnostics
from ds_sim.simulator import Command

Drive = Callable[[NDArray[np.uint8], float], Command]
"""Maps an image, (160, 320, 3) uint8 RGB, and a speed in m/s to a command."""

CAMERA_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches reliable and best-effort cameras, and keeps only the newest image (REP-2003)."""


class CameraSubscriber:
    """Subscribes to `camera/image_raw`, or to `camera/image_raw/compressed`, and answers each image.

    Args:
        node: node that owns the subscriptions.
        drive: called once per image; a ValueError leaves the image unanswered and is logged in one line.
        output: publishes the commands.
        compressed: subscribe to compressed images instead of raw ones.
        speed_from_odometry: subscribe to `odom`; otherwise the speed is 0.
    """

    def __init__(
        self, node: Node, drive: Drive, output: CommandOutput, *, compressed: bool, speed_from_odometry: bool
    ) -> None:
        self._node = node
        self._drive = drive
        self._output = output
        self._speed = 0.0
        self._report = LatencyDiagnostics(node)
        if compressed:
            node.create_subscription(CompressedImage, "camera/image_raw/compressed", self._on_compressed, CAMERA_QOS)
        else:
            node.create_subscription(Image, "camera/image_raw", self._on_image, CAMERA_QOS)
        if speed_from_odometry:
            node.create_subscription(Odometry, "odom", self._on_odometry, CAMERA_QOS)

    def _on_odometry(self, odometry: Odometry) -> None:
        self._speed = float(odometry.twist.twist.linear.x)

    def _on_image(self, image: Image) -> None:
        def pixels() -> NDArray[np.uint8]:
            data = np.frombuffer(image.data, np.uint8)
            return rgb_of(data, encoding=image.encoding, height=image.height, width=image.width, step=image.step)

        self._answer(image.header, pixels)

    def _on_compressed(self, image: CompressedImage) -> None:
        self._answer(image.header, lambda: rgb_of_file(bytes(image.data)))

    def _answer(self, header: Header, pixels: Callable[[], NDArray[np.uint8]]) -> None:
        began = time.monotonic()
        try:
            command = self._drive(fit_to_network(pixels()), self._speed)
            self._output.send(command, header)
        except (ValueError, cv2.error) as error:
            self._report.latency.refused += 1
            self._node.get_logger().error(
                f"frame not answered: {' '.join(str(error).split())}", throttle_duration_sec=1.0
            )
            return
        self._report.latency.add(time.monotonic() - began)
