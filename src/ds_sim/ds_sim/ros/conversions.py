"""Converts between the plain types of this project and ROS messages."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import asdict, fields
from operator import attrgetter
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from ds_interfaces.action import DriveRoad
from ds_interfaces.msg import Condition as ConditionMsg
from ds_interfaces.msg import DriveCommand, Frame, Trajectory, VehicleState
from ds_interfaces.msg import Outcome as OutcomeMsg
from ds_interfaces.msg import Reason as ReasonMsg
from ds_interfaces.msg import Road as RoadMsg
from ds_interfaces.srv import GetSimulatorInfo
from geometry_msgs.msg import Point, Quaternion, Transform, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.action.server import ServerGoalHandle
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ds_road import Road, road_from_fields
from ds_sim.camera.look import Colour, Look
from ds_sim.camera.spec import CameraSpec
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import from_pairs
from ds_sim.frames import GROUND_TRUTH_COVARIANCE, ROAD_FRAME, Pose
from ds_sim.session import NO_IMAGE, RunRecord
from ds_sim.simulator import (
    FRAME_RATE,
    MAX_SPEED,
    AutopilotGains,
    Command,
    LaneState,
    Observation,
    Outcome,
    Reason,
    SimulatorSpec,
)
from ds_sim.simulator import VehicleState as PlainState

_VEHICLE = tuple(field.name for field in fields(PlainState))
_LANE = tuple(field.name for field in fields(LaneState))
_COMMAND = tuple(field.name for field in fields(Command))

FEEDBACK_EVERY = 10
"""Frames between two feedback messages of a run; two messages per simulated second."""


def to_time(seconds: float) -> Time:
    """Convert seconds to a stamp, rounded to the nanosecond."""
    nanoseconds = round(seconds * 1e9)
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def road_from_message(message: RoadMsg) -> Road:
    """Convert a message to a road; computes the id instead of copying it.

    Raises:
        ds_road.RoadError: the fields do not define a road.
    """
    return road_from_fields(
        [(point.x, point.y) for point in message.control_points],
        lane_width=message.lane_width,
        sampled=message.sampled,
        maxitwo_compatible=message.maxitwo_compatible,
        left_lane=message.left_lane,
    )


def road_to_message(road: Road) -> RoadMsg:
    """Convert a road to a message from which `road_from_message` makes an equal road."""
    return RoadMsg(
        road_id=road.road_id,
        control_points=[Point(x=x, y=y) for x, y in road.control_points],
        lane_width=road.lane_width,
        sampled=road.sampled,
        maxitwo_compatible=road.maxitwo_compatible,
        left_lane=road.lane == "left",
    )


def conditions_from_messages(messages: Sequence[ConditionMsg]) -> Conditions:
    """Convert messages to conditions; what they do not name has its default.

    Raises:
        ds_sim.ConditionsError: one is unknown, named twice or out of range, or they contradict each other.
    """
    return from_pairs((message.name, message.value) for message in messages)


def conditions_to_messages(conditions: Conditions, *, explicit: bool = False) -> list[ConditionMsg]:
    """Convert conditions to messages from which `conditions_from_messages` makes equal ones.

    Args:
        conditions: what differs from the default is named.
        explicit: name one with its default value where nothing differs, so that a node's parameter does not count.
    """
    named = conditions.changed or ({"line_contrast": conditions.line_contrast} if explicit else {})
    return [ConditionMsg(name=name, value=value) for name, value in named.items()]


def command_from_message(message: DriveCommand) -> Command:
    """Convert a message to a command.

    Raises:
        ds_sim.simulator.CommandError: a value is NaN or out of range.
    """
    return Command(message.steering, message.throttle)


def image_to_message(observation: Observation, header: Header) -> Image:
    """Convert the image of an observation, rgb8."""
    return pixels_to_message(observation.image, header)


def pixels_to_message(pixels: NDArray[np.uint8], header: Header) -> Image:
    """Convert pixels, (rows, columns, 3) RGB, rgb8."""
    rows, columns, channels = pixels.shape
    message = Image(header=header, height=rows, width=columns, encoding="rgb8", step=columns * channels)
    message.data = pixels.tobytes()  # assigning an array or a list takes a thousand times as long
    return message


def pixels_of(message: Image) -> NDArray[np.uint8]:
    """Return the pixels of an rgb8 image, (rows, columns, 3), without copying them.

    Raises:
        ValueError: another encoding, or another number of bytes.
    """
    if message.encoding != "rgb8" or len(message.data) != message.height * message.width * 3:
        raise ValueError(
            f"image of encoding {message.encoding!r}, {message.width} x {message.height} px and {len(message.data)} "
            "bytes, expected rgb8 with three bytes a pixel"
        )
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)


def frame_to_message(observation: Observation, header: Header, spec: SimulatorSpec) -> Frame:
    """Convert one frame to the message that a driving network needs."""
    return Frame(
        header=header,
        step=observation.step,
        speed=observation.vehicle.speed,
        crop_top=spec.crop_top,
        crop_bottom=spec.crop_bottom,
        wheelbase=spec.wheelbase,
        max_steering_angle=spec.max_steering_angle,
        image=image_to_message(observation, header),
    )


def camera_info_message(camera: CameraSpec, header: Header) -> CameraInfo:
    """Make the message with intrinsics and distortion of the delivered image, exact for `cv2.undistort`.

    The wide-angle lens is a `rational_polynomial`, not ROS's `equidistant`, which image_geometry and plain
    `cv2.undistort` would misread. P is K: an undistorted image shows the middle at the same scale.
    """
    k = camera.intrinsics
    message = CameraInfo(header=header, height=camera.height_px, width=camera.width)
    message.distortion_model = "plumb_bob" if camera.lens == "pinhole" else "rational_polynomial"
    message.d = list(camera.distortion)
    message.k = k.ravel().tolist()
    message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message.p = [*k[0].tolist(), 0.0, *k[1].tolist(), 0.0, *k[2].tolist(), 0.0]
    return message


def state_to_message(observation: Observation, header: Header, road_id: str) -> VehicleState:
    """Convert vehicle and lane state of one frame to a message."""
    vehicle, lane = observation.vehicle, observation.lane
    return VehicleState(
        header=header,
        road_id=road_id,
        step=observation.step,
        simulated_time=observation.time,
        x=vehicle.x,
        y=vehicle.y,
        yaw=vehicle.yaw,
        speed=vehicle.speed,
        lateral_speed=vehicle.lateral_speed,
        yaw_rate=vehicle.yaw_rate,
        steering_angle=vehicle.steering_angle,
        roll=vehicle.roll,
        pitch=vehicle.pitch,
        heave=vehicle.heave,
        lateral_position=lane.lateral_position,
        lateral_distance=lane.lateral_distance,
        preview_lateral_position=lane.preview_lateral_position,
        arc_length=lane.arc_length,
        outcome=OutcomeMsg(value=int(observation.outcome)),
    )


def odometry_message(vehicle: PlainState, header: Header, child_frame: str) -> Odometry:
    """Make the odometry: pose in the road frame, twist in the vehicle frame (REP-105), ground-truth covariances."""
    message = Odometry(header=Header(stamp=header.stamp, frame_id=ROAD_FRAME), child_frame_id=child_frame)
    message.pose.pose.position = Point(x=vehicle.x, y=vehicle.y)
    message.pose.pose.orientation = Quaternion(z=math.sin(vehicle.yaw / 2), w=math.cos(vehicle.yaw / 2))
    message.twist.twist.linear.x = vehicle.speed
    message.twist.twist.linear.y = vehicle.lateral_speed
    message.twist.twist.angular.z = vehicle.yaw_rate
    message.pose.covariance = message.twist.covariance = GROUND_TRUTH_COVARIANCE
    return message


def transform_message(pose: Pose, stamp: Time, parent: str, child: str) -> TransformStamped:
    """Convert the pose of a child frame in its parent to a message for tf2."""
    (x, y, z), (qx, qy, qz, qw) = pose
    message = TransformStamped(header=Header(stamp=stamp, frame_id=parent), child_frame_id=child)
    message.transform = Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    return message


def info_response(spec: SimulatorSpec, response: GetSimulatorInfo.Response) -> GetSimulatorInfo.Response:
    """Fill in the description of a simulator."""
    response.name = spec.name
    response.physics = spec.physics
    response.version = spec.engine
    response.frame_rate = FRAME_RATE
    response.max_speed = MAX_SPEED
    response.image_width = spec.camera.width
    response.image_height = spec.camera.height_px
    response.crop_top = spec.crop_top
    response.crop_bottom = spec.crop_bottom
    response.vehicle_length = spec.vehicle_length
    response.vehicle_width = spec.vehicle_width
    response.wheelbase = spec.wheelbase
    response.max_steering_angle = spec.max_steering_angle
    for gain, value in asdict(spec.autopilot).items():
        setattr(response, f"autopilot_{gain}", value)
    extra = spec.extra | {"conditions": ",".join(spec.conditions)}
    response.parameters = [f"{key}={value}" for key, value in extra.items()]
    return response


def gains_of(info: GetSimulatorInfo.Response) -> AutopilotGains:
    """Return the reference driver's gains for the vehicle of a simulator."""
    return AutopilotGains(**{field.name: getattr(info, f"autopilot_{field.name}") for field in fields(AutopilotGains)})


def drive_feedback(observation: Observation, road: Road) -> DriveRoad.Feedback:
    """Make the feedback on the progress of a run."""
    return DriveRoad.Feedback(
        step=observation.step,
        progress=min(max(observation.lane.arc_length / road.length, 0.0), 1.0),
        lateral_position=observation.lane.lateral_position,
    )


def drive_result(run: RunRecord) -> DriveRoad.Result:
    """Convert a run to a result: outcome, measures, the last frame, and the whole trajectory."""
    result = DriveRoad.Result(
        outcome=OutcomeMsg(value=int(run.outcome)),
        reason=ReasonMsg(value=int(run.reason)),
        message=run.message,
        fitness=run.fitness,
        max_lateral_position=run.max_lateral_position,
        steps=run.steps,
        simulated_seconds=run.simulated_seconds,
        trajectory=trajectory_of(run),
        conditions=conditions_to_messages(run.conditions),
    )
    if run.observations:
        last = run.observations[-1]
        header = Header(stamp=to_time(last.time), frame_id=ROAD_FRAME)
        result.final_state = state_to_message(last, header, run.road.road_id)
    return result


def trajectory_of(run: RunRecord) -> Trajectory:
    """Convert the frames and commands of a run to columns."""
    frames, commands = run.observations, run.commands
    vehicles, lanes = [frame.vehicle for frame in frames], [frame.lane for frame in frames]
    columns: dict[str, array[float]] = {"time": array("d", [frame.time for frame in frames])}
    for names, rows in ((_VEHICLE, vehicles), (_LANE, lanes), (_COMMAND, commands)):
        columns |= {name: array("d", map(attrgetter(name), rows)) for name in names}
    steps, outcomes = array("I", [frame.step for frame in frames]), array("B", [frame.outcome for frame in frames])
    return Trajectory(step=steps, outcome=outcomes, **columns)


def observations_of(trajectory: Trajectory) -> list[Observation]:
    """Convert a trajectory's columns to observations, without images.

    Raises:
        ValueError: the columns differ in length, or an outcome is unknown.
    """
    vehicles = zip(*(getattr(trajectory, name) for name in _VEHICLE), strict=True)
    lanes = zip(*(getattr(trajectory, name) for name in _LANE), strict=True)
    rows = zip(trajectory.step, trajectory.time, trajectory.outcome, vehicles, lanes, strict=True)
    return [
        Observation(
            image=NO_IMAGE,
            step=step,
            time=time,
            vehicle=PlainState(**dict(zip(_VEHICLE, vehicle, strict=True))),
            lane=LaneState(**dict(zip(_LANE, lane, strict=True))),
            outcome=Outcome(outcome),
        )
        for step, time, outcome, vehicle, lane in rows
    ]


def commands_of(trajectory: Trajectory) -> list[Command]:
    """Convert a trajectory's columns to commands; command k led from frame k to frame k + 1.

    Raises:
        ValueError: the columns differ in length, or a command is out of range.
    """
    return [Command(*pair) for pair in zip(trajectory.steering, trajectory.throttle, strict=True)]


def refusal_result(kind: Any, reason: Reason, message: str) -> Any:
    """Make the result of a refused goal of an action; that of `drive_road` is an error without a run."""
    result = kind.Result(reason=ReasonMsg(value=int(reason)), message=message)
    if hasattr(result, "outcome"):
        result.outcome.value = int(Outcome.SIM_ERROR)
    return result


def close_goal(goal: ServerGoalHandle, outcome: Outcome) -> None:
    """Set a goal's final state; the action succeeds with any verdict on the driver, including a failed test."""
    if outcome is Outcome.CANCELLED and goal.is_cancel_requested:
        goal.canceled()
    elif outcome.is_error:
        goal.abort()
    else:
        goal.succeed()


def road_markers(road: Road, look: Look, stamp: Time) -> MarkerArray:
    """Make line strips for RViz and Foxglove: edges and centre line of the road, in the colours of `look`."""
    lines = ((road.left_edge, look.edge_line), (road.points, look.centre_line), (road.right_edge, look.edge_line))
    markers = []
    for index, (line, colour) in enumerate(lines):
        marker = Marker(header=Header(stamp=stamp, frame_id=ROAD_FRAME), ns="road", id=index, type=Marker.LINE_STRIP)
        marker.scale.x = look.line_width
        marker.pose.orientation.w = 1.0
        marker.color = _colour(colour)
        marker.points = [Point(x=float(x), y=float(y)) for x, y in line]
        markers.append(marker)
    return MarkerArray(markers=markers)


def _colour(colour: Colour) -> ColorRGBA:
    red, green, blue = (float(v) / 255.0 for v in colour)
    return ColorRGBA(r=red, g=green, b=blue, a=1.0)
