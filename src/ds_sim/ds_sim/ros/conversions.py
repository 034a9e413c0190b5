# SPDX-License-Identifier: Apache-2.0
"""Converts between the plain types of this project and ROS messages."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import asdict, fields
from functools import cache
from importlib import import_module
from operator import attrgetter
from typing import Any

import numpy as np
from ds_interfaces.action import DriveRoad
from ds_interfaces.msg import Condition as ConditionMsg
from ds_interfaces.msg import DriveCommand, Frame, Trajectory
from ds_interfaces.msg import Outcome as OutcomeMsg
from ds_interfaces.msg import Reason as ReasonMsg
from ds_interfaces.msg import Road as RoadMsg
from ds_interfaces.srv import GetSimulatorInfo
from numpy.typing import NDArray
from rclpy.action.server import ServerGoalHandle
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from ds_road import Road
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import from_pairs
from ds_sim.messages import ROAD_FRAME, MessageBuilder
from ds_sim.session import NO_IMAGE, RunRecord
from ds_sim.simulator import (
    FRAME_RATE,
    MAX_SPEED,
    AutopilotGains,
    Command,
    CommandError,
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
_SPEC = (
    *("name", "physics", "crop_top", "crop_bottom", "vehicle_length", "vehicle_width", "wheelbase"),
    "max_steering_angle",
)
"""Fields that a simulator's spec and its description by `get_info` share."""

MOST_WORDS = 300
"""Characters that are repeated of what a driver says; chosen: three lines of a terminal."""
FEEDBACK_EVERY = 10
"""Frames between two feedback messages of a run; two messages per simulated second."""


@cache
def _type_named(name: str) -> Any:
    package, kind = name.split("/")
    return getattr(import_module(f"{package}.msg"), kind)


def _packed(values: NDArray[Any]) -> array[Any]:
    """Convert numbers to what messages keep as it is; a list or an array takes a thousand times as long."""
    return array(values.dtype.char, values.tobytes())


def message_builder(namespace: str = "") -> MessageBuilder:
    """Make the builder of the messages of one simulator; its namespace prefixes its tf frames."""
    return MessageBuilder(_type_named, _packed, namespace)


MESSAGES = message_builder()
"""Builds messages that name no frame of a simulator."""


def road_to_message(road: Road) -> RoadMsg:
    """Convert a road to a message from which `ds_sim.messages.road_from_message` makes an equal road."""
    message: RoadMsg = MESSAGES.road(road)
    return message


def conditions_from_messages(messages: Sequence[ConditionMsg]) -> Conditions:
    """Convert messages to conditions; ConditionsError if they cannot be. What they do not name has its default."""
    return from_pairs((message.name, message.value) for message in messages)


def conditions_to_messages(conditions: Conditions) -> list[ConditionMsg]:
    """Convert what differs from the default, so that `conditions_from_messages` makes equal conditions."""
    return [ConditionMsg(name=name, value=value) for name, value in conditions.changed.items()]


def command_from_message(message: DriveCommand) -> Command:
    """Convert a message to a command; CommandError if it cannot be, or if the driver says why it has none."""
    if message.refusal:
        raise CommandError(" ".join(message.refusal.split())[:MOST_WORDS])
    return Command(message.steering, message.throttle)


def pixels_of(message: Image) -> NDArray[np.uint8]:
    """Pixels of an rgb8 image, (rows, columns, 3), without a copy; ValueError for any other image."""
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
        image=MESSAGES.image(observation.image, header),
    )


def info_response(spec: SimulatorSpec, response: GetSimulatorInfo.Response) -> GetSimulatorInfo.Response:
    """Fill in the description of a simulator."""
    for name in _SPEC:
        setattr(response, name, getattr(spec, name))
    response.version = spec.engine
    response.frame_rate, response.max_speed = FRAME_RATE, MAX_SPEED
    response.image_width, response.image_height = spec.camera.width, spec.camera.height_px
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
        header = MESSAGES.header(round(last.time * 1e9), ROAD_FRAME)
        result.final_state = MESSAGES.state(last, header, run.road.road_id)
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
    """Convert a trajectory's columns to observations without images; ValueError for unequal or unknown ones."""
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
    """Convert a trajectory's columns to commands; command k led from frame k to frame k + 1."""
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
