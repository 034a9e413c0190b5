"""Builds a bag's messages from plain types, without ROS, one by one or those of all frames of a run at once.

They equal the messages of the live graph (`ds_sim.ros.conversions`); a test compares the bytes of both.
"""

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
from ds_road import Road
from ds_sim.camera.look import Look
from ds_sim.camera.spec import CameraSpec
from ds_sim.frames import (
    GROUND_TRUTH_COVARIANCE,
    ROAD_FRAME,
    Pose,
    base_frame,
    body_pose,
    body_rotations,
    camera_frame,
    camera_pose,
)
from ds_sim.session import RunRecord
from ds_sim.simulator import Command, Observation, VehicleState

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


class MessageFactory:
    """Builds the messages of one simulator's bag.

    Args:
        namespace: namespace of the simulator, which prefixes its tf frames.
    """

    def __init__(self, namespace: str) -> None:
        self._types: Any = typestore().types
        self.camera_frame, self.base_frame = camera_frame(namespace), base_frame(namespace)

    def _make(self, name: str, **fields: Any) -> Any:
        package, kind = name.split("/")
        return self._types[f"{package}/msg/{kind}"](**fields)

    def _header(self, nanoseconds: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self._make("std_msgs/Header", stamp=stamp, frame_id=frame)

    def _vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
        return self._make("geometry_msgs/Vector3", x=x, y=y, z=z)

    def _point(self, x: float, y: float) -> Any:
        return self._make("geometry_msgs/Point", x=float(x), y=float(y), z=0.0)

    def _quaternion(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, w: float = 1.0) -> Any:
        return self._make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def road(self, road: Road) -> Any:
        """A road with everything that defines it."""
        return self._make(
            "ds_interfaces/Road",
            road_id=road.road_id,
            control_points=[self._point(x, y) for x, y in road.control_points],
            lane_width=road.lane_width,
            sampled=road.sampled,
            maxitwo_compatible=road.maxitwo_compatible,
            left_lane=road.lane == "left",
        )

    def outcome(self, value: int) -> Any:
        """The outcome of a run, or RUNNING."""
        return self._make("ds_interfaces/Outcome", value=value)

    def state(self, seen: Observation, road_id: str, nanoseconds: int) -> Any:
        """Vehicle and lane state of one frame."""
        vehicle, lane = seen.vehicle, seen.lane
        return self._make(
            "ds_interfaces/VehicleState",
            header=self._header(nanoseconds, ROAD_FRAME),
            step=seen.step,
            simulated_time=seen.time,
            **{name: getattr(vehicle, name) for name in vehicle.__dataclass_fields__},
            **{name: getattr(lane, name) for name in lane.__dataclass_fields__},
            outcome=self.outcome(int(seen.outcome)),
            road_id=road_id,
        )

    def command(self, command: Command, nanoseconds: int) -> Any:
        """The driver's command in answer to the frame of this time."""
        header = self._header(nanoseconds, ROAD_FRAME)
        return self._make(
            "ds_interfaces/DriveCommand", header=header, steering=command.steering, throttle=command.throttle
        )

    def odometry(self, vehicle: VehicleState, nanoseconds: int) -> Any:
        """Planar pose in the road frame, twist in the vehicle's (REP-105); covariances mark it as ground truth."""
        pose = self._make(
            "geometry_msgs/Pose",
            position=self._point(vehicle.x, vehicle.y),
            orientation=self._quaternion(z=float(np.sin(vehicle.yaw / 2)), w=float(np.cos(vehicle.yaw / 2))),
        )
        twist = self._make(
            "geometry_msgs/Twist",
            linear=self._vector(vehicle.speed, vehicle.lateral_speed),
            angular=self._vector(z=vehicle.yaw_rate),
        )
        return self._make(
            "nav_msgs/Odometry",
            header=self._header(nanoseconds, ROAD_FRAME),
            child_frame_id=self.base_frame,
            pose=self._make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=GROUND_TRUTH_COVARIANCE),
            twist=self._make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=GROUND_TRUTH_COVARIANCE),
        )

    def _transform(self, nanoseconds: int, parent: str, child: str, pose: Pose) -> Any:
        place, turn = pose
        transform = self._make(
            "geometry_msgs/Transform", translation=self._vector(*place), rotation=self._quaternion(*turn)
        )
        stamped = self._make(
            "geometry_msgs/TransformStamped",
            header=self._header(nanoseconds, parent),
            child_frame_id=child,
            transform=transform,
        )
        return self._make("tf2_msgs/TFMessage", transforms=[stamped])

    def body_transform(self, vehicle: VehicleState, nanoseconds: int) -> Any:
        """Pose of the body in the road frame, roll, pitch and heave included."""
        return self._transform(nanoseconds, ROAD_FRAME, self.base_frame, body_pose(vehicle))

    def camera_transform(self, camera: CameraSpec, nanoseconds: int) -> Any:
        """Pose of the camera's optical frame in the body's frame."""
        return self._transform(nanoseconds, self.base_frame, self.camera_frame, camera_pose(camera))

    def camera_info(self, camera: CameraSpec, nanoseconds: int) -> Any:
        """Intrinsics and distortion of the delivered image; equals `ds_sim.ros.conversions.camera_info_message`."""
        k = camera.intrinsics
        nothing = self._make(
            "sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._make(
            "sensor_msgs/CameraInfo",
            header=self._header(nanoseconds, self.camera_frame),
            height=camera.height_px,
            width=camera.width,
            distortion_model="plumb_bob" if camera.lens == "pinhole" else "rational_polynomial",
            d=np.array(camera.distortion),
            k=k.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack((k, np.zeros(3))).ravel(),
            binning_x=0,
            binning_y=0,
            roi=nothing,
        )

    def image(self, seen: Observation, nanoseconds: int) -> Any:
        """The image as it is, rgb8."""
        rows, columns, channels = seen.image.shape
        return self._make(
            "sensor_msgs/Image",
            header=self._header(nanoseconds, self.camera_frame),
            height=rows,
            width=columns,
            encoding="rgb8",
            is_bigendian=0,
            step=columns * channels,
            data=seen.image.reshape(-1),
        )

    def compressed_image(self, seen: Observation, nanoseconds: int) -> Any:
        """The image as JPEG, of the quality of our training data."""
        from ds_sim.camera.encodings import jpeg

        return self._make(
            "sensor_msgs/CompressedImage",
            header=self._header(nanoseconds, self.camera_frame),
            format="rgb8; jpeg compressed bgr8",  # as image_transport has it: the source, the codec, what OpenCV gives
            data=np.frombuffer(jpeg(seen.image), np.uint8),
        )

    def road_markers(self, road: Road, look: Look, nanoseconds: int) -> Any:
        """The road as RViz and Foxglove draw it: surface edges in white, centre line in yellow."""
        lines = ((road.left_edge, look.edge_line), (road.points, look.centre_line), (road.right_edge, look.edge_line))
        markers = [self._line(i, line, look.line_width, c, nanoseconds) for i, (line, c) in enumerate(lines)]
        return self._make("visualization_msgs/MarkerArray", markers=markers)

    def _line(self, number: int, points: Any, width: float, colour: tuple[int, int, int], nanoseconds: int) -> Any:
        red, green, blue = (float(v) / 255.0 for v in colour)
        header = self._header(0, "")
        nothing = self._make("sensor_msgs/CompressedImage", header=header, format="", data=np.zeros(0, np.uint8))
        return self._make(
            "visualization_msgs/Marker",
            header=self._header(nanoseconds, ROAD_FRAME),
            ns="road",
            id=number,
            type=4,  # LINE_STRIP
            action=0,
            pose=self._make("geometry_msgs/Pose", position=self._point(0.0, 0.0), orientation=self._quaternion()),
            scale=self._vector(width),
            color=self._make("std_msgs/ColorRGBA", r=red, g=green, b=blue, a=1.0),
            lifetime=self._make("builtin_interfaces/Duration", sec=0, nanosec=0),
            frame_locked=False,
            points=[self._point(x, y) for x, y in points],
            colors=[],
            texture_resource="",
            texture=nothing,
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=self._make("visualization_msgs/MeshFile", filename="", data=np.zeros(0, np.uint8)),
            mesh_use_embedded_materials=False,
        )


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
