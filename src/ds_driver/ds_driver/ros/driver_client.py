# SPDX-License-Identifier: Apache-2.0
"""Queries a driver node in place of a simulator: publishes recorded images one by one and waits for each answer."""

from __future__ import annotations

import time
from types import TracebackType

import rclpy
from ds_interfaces.msg import DriveCommand, Frame, VehicleState
from ds_interfaces.srv import GetSimulatorInfo
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from ds_base.errors import RunError
from ds_driver.data.recordings import RecordedFrame
from ds_driver.networks.images import Crop
from ds_sim.frames import camera_frame
from ds_sim.ros.conversions import MESSAGES
from ds_sim.ros.runtime import init_ros
from ds_sim.simulator import FRAME_TIME

ANSWER_LIMIT = 10.0
"""Longest wait for the answer to one image, s; as in `ds drive`."""
REPEAT = 0.5
"""Time after which an unanswered image is sent again, s; as in a simulator's node."""


class NoDriverError(RunError):
    """No driver node subscribes to images in the namespace."""


class DriverClient:
    """Calls a driver node as a function of frames, in place of the simulator in its namespace."""

    def __init__(self, namespace: str) -> None:
        init_ros()
        self._namespace = namespace
        self._node = Node("bag_questions", start_parameter_services=False)
        self._image = self._node.create_publisher(Image, f"{namespace}/camera/image_raw", 5)
        self._state = self._node.create_publisher(VehicleState, f"{namespace}/state", 50)
        self._frame = self._node.create_publisher(Frame, f"{namespace}/frame", 5)
        self._node.create_subscription(DriveCommand, f"{namespace}/drive", self._on_command, 10)
        self._node.create_service(GetSimulatorInfo, f"{namespace}/get_info", self._on_get_info)
        self._asked = Header()
        self._answer: float | None = None
        self._count = self._step = 0
        self._crop: Crop | None = None

    def wait_for_driver(self, limit: float = 20.0) -> None:
        """Wait until a node subscribes to images or frames and publishes commands.

        Raises:
            NoDriverError: there is none within `limit` seconds.
        """
        deadline = time.monotonic() + limit
        publishers = (self._frame, self._image)
        while not (
            any(publisher.get_subscription_count() for publisher in publishers)
            and self._node.count_publishers(f"{self._namespace}/drive")
        ):
            if time.monotonic() > deadline:
                raise NoDriverError(f"after {limit:.0f} s there is no driver for {self._namespace}: start one first")
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def __call__(self, frame: RecordedFrame, crop: Crop) -> float | None:
        """Return the node's steering for one image, (160, 320, 3), or None if it does not answer in time.

        A change of the crop begins another run, as a driver may ask for the crop only then.
        """
        assert frame.image is not None
        self._step = self._step + 1 if crop == self._crop else 0
        self._crop = crop
        # Stamps never repeat, so a late answer is not taken for the next image's.
        self._count += 1
        self._asked = MESSAGES.header(round((1.0 + self._count * FRAME_TIME) * 1e9), camera_frame(self._namespace))
        self._answer = None
        image = MESSAGES.image(frame.image, self._asked)
        state = VehicleState(header=self._asked, step=self._step, speed=frame.speed)
        whole = Frame(header=self._asked, step=self._step, speed=frame.speed, image=image)
        whole.crop_top, whole.crop_bottom = crop.top, crop.bottom
        if (vehicle := frame.seen(crop).vehicle) is not None:
            whole.wheelbase, whole.max_steering_angle = vehicle.wheelbase, vehicle.max_steering_angle
        deadline, again = time.monotonic() + ANSWER_LIMIT, 0.0
        while self._answer is None and time.monotonic() < deadline:
            if time.monotonic() >= again:
                self._state.publish(state)
                self._image.publish(image)
                self._frame.publish(whole)
                again = time.monotonic() + REPEAT
            rclpy.spin_once(self._node, timeout_sec=0.05)
        return self._answer

    def _on_get_info(self, _: object, response: GetSimulatorInfo.Response) -> GetSimulatorInfo.Response:
        crop = self._crop or Crop()
        response.name, response.crop_top, response.crop_bottom = "recording", crop.top, crop.bottom
        return response

    def _on_command(self, message: DriveCommand) -> None:
        if message.header.stamp == self._asked.stamp and -1.0 <= message.steering <= 1.0:
            self._answer = float(message.steering)

    def __enter__(self) -> DriverClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown()
