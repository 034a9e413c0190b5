"""Publishes the frames of a simulator to /tf and /tf_static, where ROS has tf2_msgs."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from ds_sim.camera.spec import CameraSpec
from ds_sim.frames import ROAD_FRAME, body_pose, camera_pose
from ds_sim.ros.conversions import transform_message
from ds_sim.simulator import VehicleState

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the ROS wheels on PyPI do not include it
    TFMessage = None


class TransformPublisher:
    """Publishes road -> vehicle with every frame, and vehicle -> camera once, latched.

    Args:
        node: node that owns the publishers.
        camera: camera of the simulator.
        camera_frame: name of the camera's optical frame.
        base_frame: name of the vehicle's frame.
    """

    def __init__(self, node: Node, camera: CameraSpec, camera_frame: str, base_frame: str) -> None:
        self._base_frame = base_frame
        self._moving: Any = None
        if TFMessage is None:
            node.get_logger().info("tf2_msgs is not installed: no /tf is published")
            return
        self._moving = node.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._fixed = node.create_publisher(TFMessage, "/tf_static", latched)
        fixed = transform_message(camera_pose(camera), Time(), base_frame, camera_frame)
        self._fixed.publish(TFMessage(transforms=[fixed]))

    def publish(self, vehicle: VehicleState, stamp: Time) -> None:
        """Publish the vehicle's pose if there is a subscriber."""
        if self._moving is not None and self._moving.get_subscription_count():
            transform = transform_message(body_pose(vehicle), stamp, ROAD_FRAME, self._base_frame)
            self._moving.publish(TFMessage(transforms=[transform]))
