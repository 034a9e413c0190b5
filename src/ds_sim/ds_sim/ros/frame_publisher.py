# SPDX-License-Identifier: Apache-2.0
"""Publishes a simulator's frames: image, vehicle state, both in one, camera info, odometry, transforms, the road."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ds_interfaces.msg import Frame
from ds_interfaces.msg import VehicleState as VehicleStateMsg
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from ds_road import Road
from ds_sim.messages import ROAD_FRAME, START
from ds_sim.ros.conversions import frame_to_message, message_builder
from ds_sim.simulator import FRAME_TIME, Observation, Simulator, SimulatorSpec

FRAME_DEPTH = 600
"""Messages of a topic kept for subscribers that lag; chosen: 30 s of a run at 20 Hz. With 50, a recorder on a busy
machine lost a third of 75 images, driven in less than a second. At most 92 MB, if a subscriber stalls that long."""


class FramePublisher:
    """Owns the publishers of one simulator, all reliable, with names relative to the node's namespace.

    The pose of the camera on the vehicle is published once, latched. With `clock`, stamps are simulated time on /clock.
    """

    def __init__(self, node: Node, spec: SimulatorSpec, *, clock: bool = False) -> None:
        self._spec = spec
        self._make = make = message_builder(node.get_namespace())
        self._frame = node.create_publisher(Frame, "frame", 5)
        self._image = node.create_publisher(Image, "camera/image_raw", FRAME_DEPTH)
        self._compressed = node.create_publisher(CompressedImage, "camera/image_raw/compressed", FRAME_DEPTH)
        self._info = node.create_publisher(CameraInfo, "camera/camera_info", FRAME_DEPTH)
        self._state = node.create_publisher(VehicleStateMsg, "state", FRAME_DEPTH)
        self._odom = node.create_publisher(Odometry, "odom", FRAME_DEPTH)
        self._moving = node.create_publisher(TFMessage, "/tf", FRAME_DEPTH)
        self._clock = node.create_publisher(Clock, "/clock", 10) if clock else None
        # Stamps never decrease, as tf, bags and filters expect.
        self._run_start = START / 1e9
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._markers = node.create_publisher(MarkerArray, "road_markers", latched)
        self._fixed = node.create_publisher(TFMessage, "/tf_static", latched)
        self._fixed.publish(make.camera_transform(spec.camera, make.stamp(START)))

    @property
    def viewers(self) -> int:
        """Number of subscriptions to images, compressed ones and `frame` included."""
        return sum(one.get_subscription_count() for one in (self._image, self._compressed, self._frame))

    def publish(self, observation: Observation, road: Road) -> Header:
        """Publish one frame, the state before its image; return the image's header, whose stamp its answer must carry.

        What nobody subscribes to is not built. A driver that connects late gets the first frame when it is repeated.
        """
        make, vehicle, header = self._make, observation.vehicle, self._header(observation.time)
        place = Header(stamp=header.stamp, frame_id=ROAD_FRAME)
        if self._clock is not None:
            self._clock.publish(Clock(clock=header.stamp))
        messages: tuple[tuple[Any, Callable[[], Any]], ...] = (
            (self._state, lambda: make.state(observation, place, road.road_id)),
            (self._image, lambda: make.image(observation.image, header)),
            (self._compressed, lambda: make.compressed_image(observation.image, header)),
            (self._frame, lambda: frame_to_message(observation, header, self._spec)),
            (self._info, lambda: make.camera_info(self._spec.camera, header)),
            (self._odom, lambda: make.odometry(vehicle, header.stamp)),
            (self._moving, lambda: make.body_transform(vehicle, header.stamp)),
        )
        for publisher, message in messages:
            if publisher.get_subscription_count():
                publisher.publish(message())
        return header

    def publish_road(self, road: Road) -> None:
        """Publish a road for viewers, including those that join later."""
        self._markers.publish(self._make.road_markers(road, self._spec.look, self._header(0.0).stamp))

    def _header(self, seconds: float) -> Header:
        """Stamp a moment of the run, s after its start, in the camera's frame."""
        return self._make.header(round((self._run_start + seconds) * 1e9), self._make.camera_frame)

    def end_run(self, seconds: float) -> None:
        """Let the stamps of the next run follow those of one that lasted some simulated time, s."""
        self._run_start += seconds + FRAME_TIME


class DrawnRows:
    """Leaves out rows that only the driver in the simulator's own process would get, and does not look at."""

    def __init__(self, simulator: Simulator, frames: FramePublisher) -> None:
        self._simulator = simulator
        self._frames = frames
        self._seen: tuple[int, int] | None = None
        self._own = 0

    def draw_for(self, rows_seen: Callable[[SimulatorSpec], tuple[int, int] | None], *, subscriptions: int) -> None:
        """Draw from the next run on the rows that the driver in this process looks at, first and end; all if None.

        It has so many subscriptions to `frame`.
        """
        self._seen, self._own = rows_seen(self._simulator.spec), subscriptions

    def choose(self) -> None:
        """Choose the rows of the run that begins; a subscriber that comes during a run gets whole images after it."""
        if self._seen is None:
            return
        whole = (0, self._simulator.spec.camera.height_px)
        watched = self._frames.viewers > self._own
        self._simulator.draw_rows(*(whole if watched else self._seen))
