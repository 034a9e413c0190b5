# SPDX-License-Identifier: Apache-2.0
"""Connection to another simulator: a node of its own, the command, the road, the reset, and the frames."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ds_interfaces.msg import DriveCommand
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import Image

from ds_base.folder_files import enter_folder
from ds_base.processes import USER_DOMAIN
from ds_driver.control.bicycle import Geometry
from ds_driver.control.other_stacks import KINDS, MotionRequest, set_part
from ds_road import Road
from ds_sim.ros.conversions import road_to_message
from ds_sim.ros.neighbours import names_of
from ds_sim.ros.node_thread import NodeThread
from ds_sim.ros.runtime import init_ros
from ds_sim.simulator import Command, SimulatorError
from ds_sim_ros.roads import write_road
from ds_sim_ros.ros.clocks import AtStart, LockStep, RealTime
from ds_sim_ros.ros.topics_and_services import MOST, POLL, Inbox, Pair, Services, Topics
from ds_sim_ros.settings import RosSettings

TRIGGER = "std_srvs/srv/Trigger"
PARAMETERS = "rcl_interfaces/srv/GetParameters"
RECEIVER_TIME = 2.0
"""Limit for the name and the parameters of the node of a topic to be discovered, s; chosen: tenths are usual."""


class Link:
    """Drives one simulator; where it fails, as with a SimulatorError, close it and make another."""

    def __init__(self, settings: RosSettings, folder: Path) -> None:
        self._settings, self._folder = settings, folder
        own = int(os.environ.get(USER_DOMAIN) or os.environ.get("ROS_DOMAIN_ID") or 0)
        domain = own if settings.domain is None else settings.domain
        self._claim = _Claim(f"{domain}_{settings.command.topic.strip('/').replace('/', '.')}")
        self._context = Context()
        init_ros(context=self._context, args=[], domain_id=domain)
        self._node = Node(f"digital_siblings_{os.getpid()}", context=self._context, start_parameter_services=False)
        self._thread = NodeThread(self._node)
        try:
            self._connect()
        except BaseException:
            self.close()
            raise

    def _connect(self) -> None:
        settings = self._settings
        self._command = _CommandTopic(self._node, settings)
        odometry, image = Inbox(), Inbox()
        self._wait_for(
            settings.command.topic, self._command.type_name, "command", self._node.get_subscriptions_info_by_topic
        )
        self._subscribe(settings.odometry, Odometry, odometry)
        self._subscribe(settings.image, Image, image)
        self._receiver = "" if settings.time is None else self._find_receiver()
        self._services = Services(self._node, self._thread, settings.timeout)
        topics = Topics(odometry, image, (settings.odometry, settings.image), settings.timeout)
        step = settings.time
        self._clock = RealTime(topics) if step is None else LockStep(topics, self._services, step)
        self._fresh = True

    @property
    def latency(self) -> tuple[float, float] | None:
        """See `RealTime.latency`; None in lock-step."""
        return self._clock.latency

    @property
    def is_alone(self) -> bool:
        """Whether one node alone publishes each topic; a simulator that was killed stays in the graph for 20 s."""
        return all(self._publishers(topic) == 1 for topic in (self._settings.odometry, self._settings.image))

    def begin(self, road: Road, seed: int, at_start: AtStart) -> Pair:
        """Load a road and put the vehicle at rest at its start; SimulatorError if another run has the simulator."""
        self._claim.take()
        self._load(road, seed)
        if self._fresh:
            self._clock.connect()
            self._check_alone()
            self._load(road, seed)
            self._fresh = False
        return self._clock.begin(at_start)

    def advance(self, command: Command, speed: float) -> Pair:
        """Send a command, pass one frame, and return the odometry and the image of its end.

        The speed, m/s, is what the throttle asks for, for messages that carry one.
        """
        self._send(command, speed)
        return self._clock.advance()

    def release(self) -> None:
        """End the run: ask the vehicle to stop, as time may go on there, and let other runs have it."""
        if self._claim.is_held:
            self._command.publish(Command(0.0, 0.0), 0.0)
            self._claim.release()

    def close(self) -> None:
        """Leave the ROS graph."""
        self._claim.release()
        if self._thread.end():
            self._node.destroy_node()
            self._context.try_shutdown()

    def _check_alone(self) -> None:
        for topic in (self._settings.odometry, self._settings.image):
            if (number := self._publishers(topic)) > 1:
                raise SimulatorError(f"{number} nodes publish {topic}: stop all simulators but one")

    def _publishers(self, topic: str) -> int:
        return int(self._node.count_publishers(self._node.resolve_topic_name(topic)))

    def _load(self, road: Road, seed: int) -> None:
        settings, way = self._settings, self._settings.road
        self._send(Command(0.0, 0.0), 0.0)
        if way.service is not None:
            fields = {"road": road_to_message(road), "seed": seed}
            self._services.call(way.service, {"ds_interfaces/srv/LoadRoad": fields})
        if way.file is not None and way.reload is not None:
            enter_folder(self._folder)
            write_road(road, self._folder / way.file)
            self._services.call(way.reload, {TRIGGER: {}})
        if settings.reset is not None:
            self._services.call(settings.reset, {TRIGGER: {}, "simulation_interfaces/srv/ResetSimulation": {}})

    def _send(self, command: Command, speed: float) -> None:
        """Send a command, and make sure that it is taken before the next request.

        One that has arrived has not been taken yet: an executor that looks for messages, is preempted, and then looks
        for requests finds the step first. It takes the command before the request after next, so a question that
        changes nothing stands between.
        """
        self._command.send(command, speed)
        if self._receiver:
            self._services.call(self._receiver, {PARAMETERS: {}})

    def _find_receiver(self) -> str:
        """Service with the parameters of the node that takes commands and publishes the odometry; "" if none."""
        command, odometry = (
            self._node.resolve_topic_name(name) for name in (self._settings.command.topic, self._settings.odometry)
        )
        deadline = time.monotonic() + RECEIVER_TIME
        while time.monotonic() < deadline:
            takes = names_of(self._node.get_subscriptions_info_by_topic(command))
            moves = names_of(self._node.get_publishers_info_by_topic(odometry))
            services = {f"{name}/get_parameters" for name in takes if name in moves}
            if matching := services & {name for name, _ in self._node.get_service_names_and_types()}:
                return min(matching)
            self._thread.pause(POLL)
        return ""

    def _subscribe(self, topic: str, kind: Any, inbox: Inbox) -> None:
        self._wait_for(topic, _name_of(kind), kind.__name__.lower(), self._node.get_publishers_info_by_topic)
        # Decided by the publishers that are there now: reliable where they are, so that no image is lost.
        profile = QoSProfile(depth=MOST, reliability=ReliabilityPolicy.BEST_AVAILABLE)
        self._node.create_subscription(kind, topic, inbox.put, profile)

    def _wait_for(self, topic: str, kind: str, what: str, ends: Callable[[str], list[TopicEndpointInfo]]) -> None:
        """Wait until the simulator's end of a topic has a type."""
        full, deadline = self._node.resolve_topic_name(topic), time.monotonic() + self._settings.timeout
        while kind not in (types := {one.topic_type for one in ends(full)}):
            if time.monotonic() > deadline:
                other = f", but {', '.join(sorted(types))}" if types else ""
                raise SimulatorError(
                    f"{full}: no {what} of the type {kind} after {self._settings.timeout:g} s{other}: start the "
                    f"simulator in this ROS domain ({self._context.get_domain_id()}), or correct its file"
                )
            self._thread.pause(POLL)


class _CommandTopic:
    """Publishes commands as the message that the simulator knows."""

    def __init__(self, node: Node, settings: RosSettings) -> None:
        self._node, command, vehicle = node, settings.command, settings.vehicle
        self._timeout = settings.timeout
        self._geometry = Geometry(vehicle.wheelbase, vehicle.max_steering_angle)
        self._kind = KINDS.get(command.type)
        try:
            self._type = DriveCommand if self._kind is None else self._kind.message_class
        except ValueError as error:
            raise SimulatorError(f"command.type {command.type}: {error}") from None
        # Reliable and acknowledged before each step, or a command might reach a simulator after its step.
        self._publisher = node.create_publisher(self._type, command.topic, 1)
        self.type_name, self._topic = _name_of(self._type), node.resolve_topic_name(command.topic)

    def send(self, command: Command, speed: float) -> None:
        self.publish(command, speed)
        if not self._publisher.wait_for_all_acked(Duration(seconds=self._timeout)):
            raise SimulatorError(f"{self._topic}: no command was taken within {self._timeout:g} s: it hangs")

    def publish(self, command: Command, speed: float) -> None:
        self._publisher.publish(self._message(command, speed))

    def _message(self, command: Command, speed: float) -> Any:
        message = self._type()
        if self._kind is None:
            message.steering, message.throttle = command.steering, command.throttle
            return message
        throttle = command.throttle if self._kind.needs_throttle else None
        motion = MotionRequest(command.steering, speed=speed if throttle is None else None, throttle=throttle)
        self._kind.fill(message, motion, self._geometry)
        if self._kind.stamp:
            set_part(message, self._kind.stamp, self._node.get_clock().now().to_msg())
        return message


def _name_of(kind: Any) -> str:
    """Name of a message's type, such as `sensor_msgs/msg/Image`."""
    package, folder, *_ = kind.__module__.split(".")
    return f"{package}/{folder}/{kind.__name__}"


class _Claim:
    """Keeps two runs from driving one vehicle at a time, in whatever processes of this user."""

    def __init__(self, name: str) -> None:
        self._path = Path(tempfile.gettempdir()) / f"ds_ros_simulator_{os.getuid()}_{name}.lock"
        self._file = -1

    @property
    def is_held(self) -> bool:
        return self._file >= 0

    def take(self) -> None:
        if self.is_held:
            return
        file = os.open(self._path, os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(file)
            raise SimulatorError(
                "another run drives this simulator, which has one vehicle: drive one road at a time (--workers 1)"
            ) from None
        self._file = file

    def release(self) -> None:
        if self.is_held:
            os.close(self._file)
            self._file = -1
