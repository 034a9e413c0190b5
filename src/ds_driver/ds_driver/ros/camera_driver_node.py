"""Runs a network on another ROS stack: any camera's images in, the vehicle's command messages out."""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from ds_driver.control.command_conversions import Geometry
from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.pilot import NOT_SIMULATED
from ds_driver.ros.camera_subscriber import CameraSubscriber
from ds_driver.ros.command_publisher import OUTPUTS, CommandOutput
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.simulator import MAX_SPEED, Command

MAX_CROP = 152
"""Largest number of cropped rows; `Crop` leaves at least eight of 160."""


class CameraDriver(Node):
    """Answers each image of one camera; needs neither a simulator nor its `state`."""

    def __init__(self) -> None:
        super().__init__("camera_driver")
        network = declare(self, "network", "dave2", "Shipped network, or a file of weights.")
        output = declare(self, "output", "drive_command", "Message by which it drives.", choices=OUTPUTS)
        compressed = declare(
            self, "compressed", False, "Subscribe to camera/image_raw/compressed instead of image_raw."
        )
        about = "odom: from the topic odom; none: taken as 0, for outputs that carry a speed."
        speed_from = declare(self, "speed_from", "odom", about, choices=("odom", "none"))
        about = "Speed at steering 0, m/s, for outputs that carry a speed."
        max_speed = declare(self, "max_speed", MAX_SPEED, about, low=0.01, high=100.0)
        wheelbase = declare(self, "wheelbase", 0.0, "Of the vehicle, m; 0 for unknown.", low=0.0, high=100.0)
        about = "Of the vehicle's wheels at full steering, rad; 0 for unknown."
        angle = declare(self, "max_steering_angle", 0.0, about, low=0.0, high=1.5)
        about = "Rows at the top, of the image brought to 160 rows, that the network does not see."
        top = declare(self, "crop_top", 0, about, low=0, high=MAX_CROP)
        about = "Rows at the bottom, of the image brought to 160 rows, that the network does not see."
        bottom = declare(self, "crop_bottom", 0, about, low=0, high=MAX_CROP)
        geometry = Geometry(wheelbase, angle) if wheelbase and angle else None
        sender = CommandOutput(self, output, geometry, max_speed)
        driver, crop = NetworkDriver(network), Crop(top, bottom)

        def drive(image: NDArray[np.uint8], speed: float) -> Command:
            return driver.command(image, speed, crop, simulator=NOT_SIMULATED)

        self._camera = CameraSubscriber(
            self, drive, sender, compressed=compressed, speed_from_odometry=speed_from == "odom"
        )
        self.get_logger().info(f"{network} answers images with {output}")


def main() -> None:
    """Run the driver until a signal stops it."""
    sys.exit(run_node(CameraDriver))


if __name__ == "__main__":
    main()
