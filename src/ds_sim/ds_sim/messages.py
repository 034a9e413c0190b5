# SPDX-License-Identifier: Apache-2.0
"""Messages of one simulator, with the classes of ROS or of any library, and its frames (REP-103, REP-105)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ds_road import Road, road_from_fields
from ds_sim.camera.spec import CameraSpec, Colour, Look
from ds_sim.simulator import Command, Observation, VehicleState

ROAD_FRAME = "road"
"""Fixed frame of every simulator: x and y in the plane of the road, z up, metres."""
START = 10**9
"""Stamp of the first frame of a bag, and of a node's first run, ns: tf2 takes 0 for `latest`, messages for `unset`."""
_OPTICAL = Rotation.from_quat((-0.5, 0.5, -0.5, 0.5))
"""From a body's frame (forward, left, up) to that of its optical axes (right, down, forward): REP-103."""
_EXACT, _UNKNOWN = 1e-9, 1e12
# Variances of odometry whose planar part is ground truth. All zeros would mean "unknown" (sensor_msgs/Imu) and break
# filters that invert them; robot_localization replaces zeros by 1e-9, and Gazebo's planar_move gives 1e12 to the axes
# that it does not observe. Order: x, y, z, roll, pitch, yaw.
GROUND_TRUTH_COVARIANCE: NDArray[np.float64] = np.diag([_EXACT, _EXACT, _UNKNOWN, _UNKNOWN, _UNKNOWN, _EXACT]).ravel()
"""Row-major 6 x 6 covariance of the pose (m^2, rad^2) and of the twist ((m/s)^2, (rad/s)^2) in odometry."""
GROUND_TRUTH_COVARIANCE.setflags(write=False)
_LINE_STRIP = 4
"""Of `visualization_msgs/Marker`."""


class MessageBuilder:
    """Builds messages; every field is given, as some libraries have no default values.

    `type_named` returns the class of a message such as `std_msgs/Header`, which takes its fields by name; `sequence`
    converts an array to what the classes take for a sequence of numbers; the namespace prefixes the tf frames. A
    message whose frame the caller knows takes a header, one that has a frame of its own takes a stamp.
    """

    def __init__(
        self, type_named: Callable[[str], Any], sequence: Callable[[NDArray[Any]], Any], namespace: str = ""
    ) -> None:
        self._type_named = type_named
        self._sequence = sequence
        self.camera_frame, self.base_frame = frame_of(namespace, "camera_optical"), frame_of(namespace, "base_link")

    def _make(self, name: str, **fields: Any) -> Any:
        return self._type_named(name)(**fields)

    def stamp(self, nanoseconds: int) -> Any:
        """A time."""
        return self._make("builtin_interfaces/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)

    def header(self, nanoseconds: int, frame: str) -> Any:
        """A time and the frame that it is about."""
        return self._header(self.stamp(nanoseconds), frame)

    def _header(self, stamp: Any, frame: str) -> Any:
        return self._make("std_msgs/Header", stamp=stamp, frame_id=frame)

    def _vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
        return self._make("geometry_msgs/Vector3", x=x, y=y, z=z)

    def _point(self, x: float, y: float) -> Any:
        return self._make("geometry_msgs/Point", x=float(x), y=float(y), z=0.0)

    def _quaternion(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, w: float = 1.0) -> Any:
        return self._make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def _pose(self, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Any:
        turn = self._quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        return self._make("geometry_msgs/Pose", position=self._point(x, y), orientation=turn)

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

    def state(self, observation: Observation, header: Any, road_id: str) -> Any:
        """Vehicle and lane state of one frame."""
        vehicle, lane = observation.vehicle, observation.lane
        return self._make(
            "ds_interfaces/VehicleState",
            header=header,
            step=observation.step,
            simulated_time=observation.time,
            **{name: getattr(vehicle, name) for name in vehicle.__dataclass_fields__},
            **{name: getattr(lane, name) for name in lane.__dataclass_fields__},
            outcome=self.outcome(int(observation.outcome)),
            road_id=road_id,
        )

    def command(self, command: Command, header: Any) -> Any:
        """The driver's command in answer to the frame with this header's time."""
        numbers = {"steering": command.steering, "throttle": command.throttle}
        return self._make("ds_interfaces/DriveCommand", header=header, **numbers, refusal="")

    def odometry(self, vehicle: VehicleState, stamp: Any) -> Any:
        """Planar pose in the road frame, twist in the vehicle's (REP-105); covariances mark it as ground truth."""
        pose = self._pose(vehicle.x, vehicle.y, vehicle.yaw)
        twist = self._make(
            "geometry_msgs/Twist",
            linear=self._vector(vehicle.speed, vehicle.lateral_speed),
            angular=self._vector(z=vehicle.yaw_rate),
        )
        return self._make(
            "nav_msgs/Odometry",
            header=self._header(stamp, ROAD_FRAME),
            child_frame_id=self.base_frame,
            pose=self._make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=GROUND_TRUTH_COVARIANCE),
            twist=self._make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=GROUND_TRUTH_COVARIANCE),
        )

    def body_transform(self, vehicle: VehicleState, stamp: Any) -> Any:
        """Pose of the body in the road frame; its origin is on the ground below the centre when the body is at rest."""
        turn = Rotation.from_euler("ZYX", [vehicle.yaw, vehicle.pitch, vehicle.roll])
        return self._transform(stamp, ROAD_FRAME, self.base_frame, (vehicle.x, vehicle.y, vehicle.heave), turn)

    def camera_transform(self, camera: CameraSpec, stamp: Any) -> Any:
        """Pose of the camera's optical frame in the body's frame."""
        mount = Rotation.from_euler("Y", camera.pitch)
        if camera.yaw:
            mount = Rotation.from_euler("ZY", [camera.yaw, camera.pitch])
        place = (camera.forward, 0.0, camera.height)
        return self._transform(stamp, self.base_frame, self.camera_frame, place, mount * _OPTICAL)

    def _transform(self, stamp: Any, parent: str, child: str, place: tuple[float, float, float], turn: Rotation) -> Any:
        rotation = self._quaternion(*turn.as_quat().tolist())
        stamped = self._make(
            "geometry_msgs/TransformStamped",
            header=self._header(stamp, parent),
            child_frame_id=child,
            transform=self._make("geometry_msgs/Transform", translation=self._vector(*place), rotation=rotation),
        )
        return self._make("tf2_msgs/TFMessage", transforms=[stamped])

    def camera_info(self, camera: CameraSpec, header: Any) -> Any:
        """Intrinsics and distortion of the delivered image, exact for `cv2.undistort`.

        The wide-angle lens is a `rational_polynomial`, not ROS's `equidistant`, which image_geometry and plain
        `cv2.undistort` would misread. P is K: an undistorted image shows the middle at the same scale.
        """
        k = camera.intrinsics
        return self._make(
            "sensor_msgs/CameraInfo",
            header=header,
            height=camera.height_px,
            width=camera.width,
            distortion_model="plumb_bob" if camera.lens == "pinhole" else "rational_polynomial",
            d=self._sequence(np.array(camera.distortion)),
            k=k.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack((k, np.zeros(3))).ravel(),
            binning_x=0,
            binning_y=0,
            roi=self._make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
        )

    def image(self, pixels: NDArray[np.uint8], header: Any) -> Any:
        """Pixels as they are, (rows, columns, 3) RGB, as rgb8."""
        rows, columns, channels = pixels.shape
        return self._make(
            "sensor_msgs/Image",
            header=header,
            height=rows,
            width=columns,
            encoding="rgb8",
            is_bigendian=0,
            step=columns * channels,
            data=self._sequence(pixels.reshape(-1)),
        )

    def compressed_image(self, pixels: NDArray[np.uint8], header: Any) -> Any:
        """Pixels, (rows, columns, 3) RGB, as JPEG of the quality of our training data."""
        from ds_sim.camera.encodings import jpeg

        # The format is as image_transport has it: the source, the codec, what OpenCV gives.
        return self._compressed_image(header, "rgb8; jpeg compressed bgr8", jpeg(pixels))

    def _compressed_image(self, header: Any, encoding: str, data: bytes) -> Any:
        content = self._sequence(np.frombuffer(data, np.uint8))
        return self._make("sensor_msgs/CompressedImage", header=header, format=encoding, data=content)

    def road_markers(self, road: Road, look: Look, stamp: Any) -> Any:
        """The road as RViz and Foxglove draw it: edges and centre line, in the colours of `look`."""
        lines = [(road.left_edge, look.edge_line), (road.points, look.centre_line), (road.right_edge, look.edge_line)]
        lines = lines if road.has_centre_line else lines[::2]
        markers = [self._line(i, line, look.line_width, c, stamp) for i, (line, c) in enumerate(lines)]
        return self._make("visualization_msgs/MarkerArray", markers=markers)

    def _line(self, number: int, points: NDArray[np.float64], width: float, colour: Colour, stamp: Any) -> Any:
        red, green, blue = (float(v) / 255.0 for v in colour)
        nothing = np.zeros(0, np.uint8)
        return self._make(
            "visualization_msgs/Marker",
            header=self._header(stamp, ROAD_FRAME),
            ns="road",
            id=number,
            type=_LINE_STRIP,
            action=0,
            pose=self._pose(),
            scale=self._vector(width),
            color=self._make("std_msgs/ColorRGBA", r=red, g=green, b=blue, a=1.0),
            lifetime=self._make("builtin_interfaces/Duration", sec=0, nanosec=0),
            frame_locked=False,
            points=[self._point(x, y) for x, y in points],
            colors=[],
            texture_resource="",
            texture=self._compressed_image(self.header(0, ""), "", b""),
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=self._make("visualization_msgs/MeshFile", filename="", data=self._sequence(nothing)),
            mesh_use_embedded_materials=False,
        )


def road_from_message(message: Any) -> Road:
    """Convert a message of any library to a road; its id tells only lanes apart that have no field, and is computed.

    Messages of version 0.1 have control points only, those of 0.2 no lane. RoadError if the fields define no road.
    """
    return road_from_fields(
        [(point.x, point.y) for point in message.control_points],
        lane_width=float(getattr(message, "lane_width", 0.0)),
        sampled=bool(getattr(message, "sampled", False)),
        maxitwo_compatible=bool(getattr(message, "maxitwo_compatible", False)),
        left_lane=bool(getattr(message, "left_lane", False)),
        road_id=str(getattr(message, "road_id", "")),
    )


def frame_of(namespace: str, name: str) -> str:
    """Name of a frame in a namespace: `base_link` of the vehicle, or `camera_optical`, whose suffix is REP-103's."""
    return f"{namespace.strip('/')}/{name}".strip("/")
