# SPDX-License-Identifier: Apache-2.0
import contextlib

import numpy as np
import rclpy
from ds_interfaces.msg import DriveCommand
from rclpy.node import Node
from sensor_msgs.msg import Image


class LineDriver(Node):  # steers so that the yellow line stays at the lower left of the image
    def __init__(self) -> None:
        super().__init__("line_driver")
        self.publisher = self.create_publisher(DriveCommand, "drive", 1)
        self.create_subscription(Image, "camera/image_raw", self.drive, 1)

    def drive(self, image: Image) -> None:
        rgb = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)[100:140].astype(int)
        columns = np.nonzero((rgb[..., 0] > 150) & (rgb[..., 0] - rgb[..., 2] > 60))[1]
        steering = float(np.clip((columns.mean() - 90) / 120, -1, 1)) if columns.size else -0.5
        self.publisher.publish(DriveCommand(header=image.header, steering=steering, throttle=0.3))


rclpy.init()
with contextlib.suppress(KeyboardInterrupt):
    rclpy.spin(LineDriver())
