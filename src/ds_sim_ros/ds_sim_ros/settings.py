# SPDX-License-Identifier: Apache-2.0
"""The file that describes another ROS 2 simulator: its keys, and errors in one line."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator

from ds_base.config_errors import Keys, problems, read_keys
from ds_base.errors import InputError
from ds_driver.networks.images import Crop
from ds_road import Side
from ds_sim.simulator import FRAME_TIME

REALTIME = "realtime"
ROAD_FILES = (".json", ".csv")
"""Suffixes of a road that is written or read as a file."""
_NAME = re.compile(r"/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


class RosSettingsError(InputError):
    """The description of a simulator cannot be used; one line says why."""


def _ros_name(text: str) -> str:
    if not _NAME.fullmatch(text):
        raise ValueError(f"{text!r} is no name of a topic or service, expected one such as /camera/image")
    return text


def _file_name(text: str) -> str:
    if Path(text).suffix not in ROAD_FILES or "\0" in text:
        raise ValueError(f"{text!r}: expected a file that ends in {' or '.join(ROAD_FILES)}")
    return text


def _stepped(value: Any) -> Any:
    """Replace the word for real time by None, so that errors in the keys of the other form name one form only."""
    if value == REALTIME:
        return None
    if not isinstance(value, dict):
        raise ValueError(f"expected {REALTIME}, or the keys step and seconds")
    return value


def _inside(text: str) -> str:
    if Path(text).is_absolute() or ".." in Path(text).parts:
        raise ValueError(f"{text!r} lies outside of the description's folder, expected a file inside of it")
    return _file_name(text)


RosName = Annotated[str, AfterValidator(_ros_name)]
FileName = Annotated[str, AfterValidator(_file_name)]
WrittenName = Annotated[str, AfterValidator(_inside)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Angle = Annotated[float, Field(gt=0.0, lt=1.5)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Strict(Keys, strict=True, allow_inf_nan=False):
    """Base of all parts."""


class VehicleSettings(_Strict):
    """The vehicle; lengths in m."""

    length: Length
    width: Length
    wheelbase: Length
    max_steering_angle: Angle  # angle of the front wheels at |steering| = 1, rad
    # Distance from the point whose pose the odometry gives to the vehicle's centre, m, ahead positive.
    centre_ahead: Finite = 0.0


class CommandSettings(_Strict):
    """How the vehicle is commanded."""

    topic: RosName  # topic of the commands
    # This project's message, or a key of `ds_driver.control.other_stacks.KINDS`.
    type: Literal["twist", "twist_stamped", "ackermann", "servo", "autoware", "drive_command"]
    # At full throttle, see `speed_after`, m/s^2; chosen as in `examples/bicycle.py`, a small car.
    acceleration: Annotated[float, Field(gt=0.0, le=100.0)] = 3.0
    # See `speed_after`, 1/s; chosen there, too: a top speed of 36 km/h.
    drag: Annotated[float, Field(gt=0.0, le=10.0)] = 0.3

    def speed_after(self, speed: float, throttle: float) -> float:
        """Speed that a message asks for, m/s, one frame after another one: u' = acceleration * throttle - drag * u.

        It does not look at the vehicle, so that what is asked for depends on the commands alone. A speed that were
        proportional to the throttle would make equation 2 swing, as a simulator may follow within one frame. The drag
        is implicit, so that no permitted value of it makes the speed swing.
        """
        return (speed + self.acceleration * throttle * FRAME_TIME) / (1.0 + self.drag * FRAME_TIME)


class RoadSettings(_Strict):
    """How a road gets into the simulator: by a service, by a file, or not at all because the track is fixed."""

    service: RosName | None = None  # name of a service of the type ds_interfaces/srv/LoadRoad
    file: WrittenName | None = None  # file that is written before `reload` is called, inside the description's folder
    reload: RosName | None = None  # name of a service of the type std_srvs/srv/Trigger
    centre_line: FileName | None = None  # file with the track, relative to the description's folder
    # Width of each lane of the track of a CSV file, m; if None, the file's, or 4 m.
    lane_width: Annotated[float, Field(ge=1.0, le=20.0)] | None = None
    lane: Side | None = None  # driven lane of the track; the file's, or the right one, if None

    @model_validator(mode="after")
    def _one_way(self) -> RoadSettings:
        if (self.file is None) != (self.reload is None):
            raise ValueError("file and reload belong together: give both, or neither")
        if [self.service, self.file, self.centre_line].count(None) != 2:
            raise ValueError("expected exactly one of service, file with reload, and centre_line")
        return self


class StepSettings(_Strict):
    """Lock-step by a service, simulation_interfaces/srv/StepSimulation, and the simulated time of a step, s."""

    step: RosName
    seconds: Annotated[float, Field(gt=0.0, le=FRAME_TIME)]

    @model_validator(mode="after")
    def _fills_a_frame(self) -> StepSettings:
        if abs(self.per_frame * self.seconds - FRAME_TIME) > 1e-9:
            raise ValueError(f"seconds is {self.seconds:g}: no whole number of steps makes a frame of {FRAME_TIME:g} s")
        return self

    @property
    def per_frame(self) -> int:
        """Steps in a frame."""
        return round(FRAME_TIME / self.seconds)


class OriginSettings(_Strict):
    """Pose of the road frame in the odometry's frame; m, rad."""

    x: Finite = 0.0
    y: Finite = 0.0
    yaw: Finite = 0.0

    def of_moved(self, moved: tuple[float, float]) -> OriginSettings:
        """That of a road frame in which everything lies farther by some metres in x and y."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = moved
        return OriginSettings(x=self.x - cos * x + sin * y, y=self.y - sin * x - cos * y, yaw=self.yaw)


class CameraSettings(_Strict):
    """Geometry of the camera, where it is known; see `ds_sim.camera.spec.CameraSpec`. Chosen: a compact car's."""

    horizontal_fov: Annotated[float, Field(gt=0.0, lt=3.0)] = 1.6
    height: Length = 1.2
    forward: Finite = 0.0
    pitch: Finite = 0.1


class AutopilotSettings(_Strict):
    """Gains of the autopilot; see `ds_sim.simulator.AutopilotGains`. Chosen: those of the twin."""

    proportional: Finite = 0.4
    derivative: Finite = 0.0
    integral: Finite = 0.0
    preview_distance: Annotated[float, Field(ge=0.0, le=20.0)] = 4.0


class RosSettings(_Strict):
    """Description of a simulator."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.-]{0,49}$")]
    vehicle: VehicleSettings
    image: RosName  # topic of the type sensor_msgs/msg/Image
    odometry: RosName  # topic of the type nav_msgs/msg/Odometry
    origin: OriginSettings = OriginSettings()  # pose of the road frame in the frame of the odometry's pose
    command: CommandSettings
    road: RoadSettings
    # Service that puts the vehicle to the start, of the type std_srvs/srv/Trigger or
    # simulation_interfaces/srv/ResetSimulation; None if loading the road does that.
    reset: RosName | None = None
    time: Annotated[StepSettings | None, BeforeValidator(_stepped)]  # steps; None for real time.
    timeout: Annotated[float, Field(ge=0.1, le=600.0)] = 5.0  # limit of each wait, s
    domain: Annotated[int, Field(ge=0, le=232)] | None = None  # ROS domain of the simulator; None for the user's
    camera: CameraSettings | None = None  # geometry of the camera; None if it is not known
    crop_top: Annotated[int, Field(ge=0)] = 60  # image rows at the top, of 160, that a network does not see
    crop_bottom: Annotated[int, Field(ge=0)] = 0  # image rows at the bottom
    autopilot: AutopilotSettings = AutopilotSettings()

    @model_validator(mode="after")
    def _leaves_something_to_see(self) -> RosSettings:
        Crop(self.crop_top, self.crop_bottom)
        return self


def read_settings(path: Path) -> RosSettings:
    """Read and check a description; RosSettingsError says in one line the file, the key, and what was expected."""
    raw = read_keys(path, RosSettingsError)
    try:
        return RosSettings.model_validate(raw)
    except ValidationError as error:
        raise RosSettingsError(f"{path}: {problems(error, RosSettings)}") from None
