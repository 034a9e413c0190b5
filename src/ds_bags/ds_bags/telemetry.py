"""Messages of all frames of a run at once, serialised: state, odometry, body transform and command."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_bags.message_factory import MessageFactory, typestore
from ds_bags.message_table import MessageTable
from ds_sim.frames import body_rotations
from ds_sim.session import RunRecord
from ds_sim.simulator import Command

_TRANSFORM = "transforms.0.transform"


def frame_times(run: RunRecord) -> NDArray[np.int64]:
    """Time of each frame of a run, (n,), ns since its start."""
    return np.array([round(seen.time * 1e9) for seen in run.observations], np.int64)


def serialise_frames(make: MessageFactory, run: RunRecord) -> dict[str, NDArray[np.uint8]]:
    """Serialise what a run's bag has of each frame; the bytes are those of the factory's messages one by one.

    Args:
        make: makes the messages.
        run: a run of n frames, 1 or more.

    Returns:
        Topic -> (n, bytes of a message); `drive` has one row per command.
    """
    times, seen, commands = frame_times(run), run.observations, run.commands
    vehicles = [frame.vehicle for frame in seen]
    state = _table(make.state(seen[0], run.road.road_id, 0), times)
    state.put("step", [frame.step for frame in seen])
    state.put("simulated_time", [frame.time for frame in seen])
    state.put("outcome.value", [int(frame.outcome) for frame in seen])
    motion = {name: _column(vehicles, name) for name in vehicles[0].__dataclass_fields__}
    lanes = [frame.lane for frame in seen]
    place = {name: _column(lanes, name) for name in lanes[0].__dataclass_fields__}
    for name, column in (motion | place).items():
        state.put(name, column)

    odometry = _table(make.odometry(vehicles[0], 0), times)
    for path, column in {
        "pose.pose.position.x": motion["x"],
        "pose.pose.position.y": motion["y"],
        "pose.pose.orientation.z": np.sin(motion["yaw"] / 2),
        "pose.pose.orientation.w": np.cos(motion["yaw"] / 2),
        "twist.twist.linear.x": motion["speed"],
        "twist.twist.linear.y": motion["lateral_speed"],
        "twist.twist.angular.z": motion["yaw_rate"],
    }.items():
        odometry.put(path, column)

    transform = _table(make.body_transform(vehicles[0], 0), times, "transforms.0.header")
    for axis, name in zip("xyz", ("x", "y", "heave"), strict=True):
        transform.put(f"{_TRANSFORM}.translation.{axis}", motion[name])
    for axis, column in zip("xyzw", body_rotations(vehicles).T, strict=True):
        transform.put(f"{_TRANSFORM}.rotation.{axis}", column)

    drive = _table(make.command(commands[0] if commands else Command(0.0, 0.0), 0), times[: len(commands)])
    for name in ("steering", "throttle"):
        drive.put(name, _column(commands, name))
    return {"state": state.rows, "odom": odometry.rows, "/tf": transform.rows, "drive": drive.rows}


def _table(example: Any, times: NDArray[np.int64], header: str = "header") -> MessageTable:
    table = MessageTable(typestore(), example, len(times))
    table.put(f"{header}.stamp.sec", times // 10**9)
    table.put(f"{header}.stamp.nanosec", times % 10**9)
    return table


def _column(values: list[Any], name: str) -> NDArray[np.float64]:
    return np.array(list(map(attrgetter(name), values)), np.float64)
