# SPDX-License-Identifier: Apache-2.0
"""Message types of bags without ROS, and the messages of all frames of a run at once."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ds_base.errors import InputError
from ds_base.installation import share_folders
from ds_sim.frames import ROAD_FRAME, body_rotations
from ds_sim.messages import MessageBuilder
from ds_sim.session import RunRecord
from ds_sim.simulator import Command

_OWN_MESSAGES = ("Outcome", "Road", "VehicleState", "DriveCommand")


class TypesError(InputError):
    """Message definitions that are not installed."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Message types of Jazzy and of `ds_interfaces`, the latter read from their installed definitions.

    Raises:
        TypesError: the workspace's messages are not on AMENT_PREFIX_PATH.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for share in share_folders("ds_interfaces"):
        folder = share / "msg"
        if (folder / "Road.msg").exists():
            types: dict[str, Any] = {}
            for name in _OWN_MESSAGES:
                types.update(get_types_from_msg((folder / f"{name}.msg").read_text(), f"ds_interfaces/msg/{name}"))
            store.register(types)
            return store
    raise TypesError("ds_interfaces is not on AMENT_PREFIX_PATH: build the workspace and source its setup file")


def message_builder(namespace: str) -> MessageBuilder:
    """Make the builder of the messages of one simulator's bag.

    Args:
        namespace: namespace of the simulator, which prefixes its tf frames.
    """
    types = typestore().types
    return MessageBuilder(lambda name: types[name.replace("/", "/msg/")], np.asarray, namespace)


_ENCAPSULATION = 4
"""Bytes before the content of a message; its alignment counts from there (DDSI-RTPS 10.2)."""


class MessageTable:
    """CDR bytes of many messages of one type, first all equal to an example.

    Args:
        store: knows the type of the messages.
        example: message of that store with the strings and array lengths that all messages have.
        count: number of messages.

    Attributes:
        rows: (count, bytes of a message).
    """

    def __init__(self, store: Typestore, example: Any, count: int) -> None:
        message_type = example.__msgtype__
        serialised = np.frombuffer(bytes(store.serialize_cdr(example, message_type)), np.uint8)
        self.rows: NDArray[np.uint8] = np.tile(serialised, (count, 1))
        self._places = {path: (kind, at) for path, kind, at in _Layout(store).numbers(message_type, example)}

    def put(self, path: str, values: ArrayLike) -> None:
        """Put a number into each message.

        Args:
            path: names of the fields down to the number, such as `header.stamp.sec` or `transforms.0.header.stamp.sec`.
            values: (count,) numbers, within the range of the field's type.
        """
        kind, at = self._places[path]
        column = np.ascontiguousarray(values, kind)
        self.rows[:, at : at + kind.itemsize] = column.view(np.uint8).reshape(len(column), kind.itemsize)


class _Layout:
    """Walks through a message as CDR lays it out, little-endian, each value aligned to its size."""

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._at = 0

    def numbers(self, message_type: str, message: Any, path: str = "") -> Iterator[tuple[str, np.dtype[Any], int]]:
        """Yield path, type and offset of each number of a message."""
        for name, (node, detail) in self._store.fielddefs[message_type][1]:
            yield from self._value(node, detail, getattr(message, name), f"{path}{name}")

    def _value(self, node: Nodetype, detail: Any, value: Any, path: str) -> Iterator[tuple[str, np.dtype[Any], int]]:
        if node is Nodetype.NAME:
            yield from self.numbers(detail, value, f"{path}.")
        elif node is Nodetype.BASE and detail[0] == "string":
            self._skip(4, 4)
            self._at += len(value.encode()) + 1
        elif node is Nodetype.BASE:
            kind = np.dtype(detail[0]).newbyteorder("<")
            yield path, kind, _ENCAPSULATION + self._skip(kind.itemsize, kind.itemsize)
        else:
            if node is Nodetype.SEQUENCE:
                self._skip(4, 4)
            (inner, inner_detail), _ = detail
            for index, member in enumerate(value):
                yield from self._value(inner, inner_detail, member, f"{path}.{index}")

    def _skip(self, size: int, alignment: int) -> int:
        """Move past a value and return where it starts."""
        start = -(-self._at // alignment) * alignment
        self._at = start + size
        return start


_TRANSFORM = "transforms.0.transform"


def frame_times(run: RunRecord) -> NDArray[np.int64]:
    """Time of each frame of a run, (n,), ns since its start."""
    return np.array([round(seen.time * 1e9) for seen in run.observations], np.int64)


def serialise_frames(make: MessageBuilder, run: RunRecord) -> dict[str, NDArray[np.uint8]]:
    """Serialise what a run's bag has of each frame; the bytes are those of the builder's messages one by one.

    Args:
        make: makes the messages.
        run: a run of n frames, 1 or more.

    Returns:
        Topic -> (n, bytes of a message); `drive` has one row per command.
    """
    times, seen, commands = frame_times(run), run.observations, run.commands
    vehicles = [frame.vehicle for frame in seen]
    header, stamp = make.header(0, ROAD_FRAME), make.stamp(0)
    state = _table(make.state(seen[0], header, run.road.road_id), times)
    state.put("step", [frame.step for frame in seen])
    state.put("simulated_time", [frame.time for frame in seen])
    state.put("outcome.value", [int(frame.outcome) for frame in seen])
    motion = {name: _column(vehicles, name) for name in vehicles[0].__dataclass_fields__}
    lanes = [frame.lane for frame in seen]
    place = {name: _column(lanes, name) for name in lanes[0].__dataclass_fields__}
    for name, column in (motion | place).items():
        state.put(name, column)

    odometry = _table(make.odometry(vehicles[0], stamp), times)
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

    transform = _table(make.body_transform(vehicles[0], stamp), times, "transforms.0.header")
    for axis, name in zip("xyz", ("x", "y", "heave"), strict=True):
        transform.put(f"{_TRANSFORM}.translation.{axis}", motion[name])
    for axis, column in zip("xyzw", body_rotations(vehicles).T, strict=True):
        transform.put(f"{_TRANSFORM}.rotation.{axis}", column)

    drive = _table(make.command(commands[0] if commands else Command(0.0, 0.0), header), times[: len(commands)])
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
