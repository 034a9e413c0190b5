# SPDX-License-Identifier: Apache-2.0
"""Runs a network on another ROS stack: any camera's images in, the vehicle's command messages out."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace

import cv2
from ds_interfaces.msg import DriveCommand
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from ds_driver.control.bicycle import Geometry
from ds_driver.control.other_stacks import KINDS, MotionRequest, set_part
from ds_driver.networks.images import Crop, fit_to_network, rgb_of_message
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import Frame
from ds_sim.ros.conversions import MESSAGES
from ds_sim.ros.diagnostics import STALE, AnswerDiagnostics
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.simulator import MAX_SPEED, Command

OUTPUTS = ("drive_command", *KINDS)
"""Values of the parameter `output`: names of the message types."""
MAX_CROP = 152
"""Largest number of cropped rows; `Crop` leaves at least eight of 160."""
CAMERA_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches reliable and best-effort cameras, and keeps only the newest image (REP-2003)."""


class CameraDriver(Node):
    """Answers each image of one camera, of any encoding and size; needs neither a simulator nor its `state`."""

    def __init__(self) -> None:
        super().__init__("camera_driver")
        network = declare(self, "network", "dave2", "Shipped network, or a file of weights.")
        output = declare(self, "output", "drive_command", "Message by which it drives.", choices=OUTPUTS)
        about = "Subscribe to camera/image_raw/compressed instead of image_raw."
        compressed = declare(self, "compressed", False, about)
        about = "odom: from the topic odom; none: taken as 0, for outputs that carry a speed."
        speed_from = declare(self, "speed_from", "odom", about, choices=("odom", "none"))
        about = "Speed at steering 0, m/s, for outputs that carry a speed."
        max_speed = declare(self, "max_speed", MAX_SPEED, about, low=0.01, high=100.0)
        wheelbase = declare(self, "wheelbase", 0.0, "Of the vehicle, m; 0 for unknown.", low=0.0, high=100.0)
        about = "Of the vehicle's wheels at full steering, rad; 0 for unknown."
        angle = declare(self, "max_steering_angle", 0.0, about, low=0.0, high=1.5)
        about = "{} rows, of the image resized to 160 rows, that the network does not see."
        top = declare(self, "crop_top", 0, about.format("Top"), low=0, high=MAX_CROP)
        bottom = declare(self, "crop_bottom", 0, about.format("Bottom"), low=0, high=MAX_CROP)
        vehicle = Geometry(wheelbase, angle) if wheelbase and angle else None
        self._kind, self._geometry, self._max_speed = KINDS.get(output), vehicle or Geometry(1.0, 1.0), max_speed
        if vehicle is None and self._kind is not None and not self._kind.needs_throttle:
            raise ValueError(f"output {output}: set the parameters wheelbase and max_steering_angle of the vehicle")
        self._type = DriveCommand if self._kind is None else self._kind.message_class
        self._commands = self.create_publisher(self._type, "drive" if self._kind is None else self._kind.topic, 1)
        self._driver = NetworkDriver(network)
        self._seen = replace(Frame.black(), crop=Crop(top, bottom), step=1, vehicle=vehicle)
        self._speed = 0.0
        self._latency = AnswerDiagnostics(self, idle=STALE)
        kind, topic = (CompressedImage, "image_raw/compressed") if compressed else (Image, "image_raw")
        self.create_subscription(kind, f"camera/{topic}", self._on_image, CAMERA_QOS)
        if speed_from == "odom":
            self.create_subscription(Odometry, "odom", self._on_odometry, CAMERA_QOS)
        self.get_logger().info(f"{network} answers images with {output}")

    def _on_odometry(self, odometry: Odometry) -> None:
        self._speed = float(odometry.twist.twist.linear.x)

    def _on_image(self, message: Image | CompressedImage) -> None:
        """Answer an image; one that cannot be answered is logged in one line."""
        began = time.monotonic()
        try:
            image = fit_to_network(rgb_of_message(message))
            command = self._driver.command(replace(self._seen, image=image, speed=self._speed))
            self._send(command, message.header)
        except (ValueError, cv2.error) as error:
            self._latency.refused += 1
            self.get_logger().error(f"frame not answered: {' '.join(str(error).split())}", throttle_duration_sec=1.0)
            return
        self._latency.add(time.monotonic() - began)

    def _send(self, command: Command, header: Header) -> None:
        """Publish a command in answer to the image with this header.

        Messages with a speed carry, in place of a throttle, the speed at which the paper's equation 2 gives throttle 0:
        `max_speed` times the square root of 1 - steering^2.
        """
        if self._kind is None:
            self._commands.publish(MESSAGES.command(command, header))
            return
        if self._kind.needs_throttle:
            motion = MotionRequest(command.steering, throttle=command.throttle)
        else:
            speed = self._max_speed * math.sqrt(max(0.0, 1.0 - command.steering**2))
            motion = MotionRequest(command.steering, speed=speed)
        message = self._type()
        self._kind.fill(message, motion, self._geometry)
        if self._kind.stamp:
            set_part(message, self._kind.stamp, header.stamp)
        self._commands.publish(message)


def main() -> None:
    """Run the driver until a signal stops it."""
    sys.exit(run_node(CameraDriver))


if __name__ == "__main__":
    main()
