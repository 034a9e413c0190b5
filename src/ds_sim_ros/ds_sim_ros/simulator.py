# SPDX-License-Identifier: Apache-2.0
"""Any ROS 2 simulator as a sibling: what it shows and where its vehicle is come through topics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.images import ImageError, fit_to_network, rgb_of_message
from ds_road import Road
from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.parts import Scene, Vehicle
from ds_sim.road_simulator import RoadSimulator, start_of
from ds_sim.simulator import AutopilotGains, Command, Observation, Outcome, SimulatorError, SimulatorSpec, VehicleState
from ds_sim_ros.roads import check_is_track, read_track
from ds_sim_ros.settings import CameraSettings, OriginSettings, RosSettings, read_settings

if TYPE_CHECKING:
    from ds_sim_ros.ros.link import Link

UNIT_TOLERANCE = 0.01
"""Largest difference of a quaternion's norm from 1; chosen: far above the rounding of 32-bit floats."""
Answer = TypeVar("Answer")
START_DISTANCE = 0.5
"""Largest distance of a vehicle from the start of its lane, m; chosen: it still begins well inside the lane."""
START_ANGLE = 0.2
"""Largest angle between the vehicle and its lane at the start, rad; chosen: more than a simulator's settling."""
START_SPEED = 0.1
"""Largest speed at the start, m/s; chosen: a body that settles on its springs counts as at rest."""
LOOK = Look(asphalt=(90, 90, 90), grass=(90, 120, 70))
"""Stands for a look that is not known; nothing is painted with it."""
NOT_REPEATABLE = "real time: runs are not deterministic"


def image_of(message: Any, topic: str) -> NDArray[np.uint8]:
    """Bring a sensor_msgs/Image to (160, 320, 3) uint8 RGB, read-only; SimulatorError if that is impossible."""
    try:
        image = fit_to_network(rgb_of_message(message))
    except ImageError as error:
        raise SimulatorError(f"{topic}: {error}: publish rgb8 or bgr8") from None
    image = image.copy()  # the message's own bytes may be reused
    image.setflags(write=False)
    return image


class OdometryReader:
    """Converts the nav_msgs/Odometry of one run to states in the road frame."""

    def __init__(self, settings: RosSettings) -> None:
        self._topic, self._origin, self._vehicle = settings.odometry, settings.origin, settings.vehicle
        self._yaw, self._ground = 0.0, 0.0

    def begin(self, message: Any, yaw: float) -> None:
        """Begin a run at a yaw, rad, and take the present height as the ground's."""
        self._yaw, self._ground = yaw, float(message.pose.pose.position.z)

    def state(self, message: Any, steering: float) -> VehicleState:
        """Convert a nav_msgs/Odometry; yaws continue the ones before, also beyond a full circle.

        Its twist is in the vehicle's frame, as REP-105 has it. It has no angle of the wheels: the one that the last
        command asked for is reported. SimulatorError if a value is not finite, or the orientation no unit quaternion.
        """
        self._check(message)
        position, twist = message.pose.pose.position, message.twist.twist
        roll, pitch, yaw = _angles(message.pose.pose.orientation)
        yaw = self._yaw + math.remainder(yaw - self._origin.yaw - self._yaw, math.tau)
        self._yaw = yaw
        x, y = _in_road(position.x, position.y, self._origin)
        ahead = self._vehicle.centre_ahead
        return VehicleState(
            x=x + ahead * math.cos(yaw),
            y=y + ahead * math.sin(yaw),
            yaw=yaw,
            speed=twist.linear.x,
            lateral_speed=twist.linear.y + ahead * twist.angular.z,
            yaw_rate=twist.angular.z,
            steering_angle=-steering * self._vehicle.max_steering_angle,
            roll=roll,
            pitch=pitch,
            heave=position.z - self._ground,
        )

    def _check(self, message: Any) -> None:
        pose, twist = message.pose.pose, message.twist.twist
        parts = {"position": pose.position, "orientation": pose.orientation, "linear": twist.linear}
        parts["angular"] = twist.angular
        for part, value in parts.items():
            for axis in "xyzw" if part == "orientation" else "xyz":
                number = getattr(value, axis)
                if not math.isfinite(number):
                    raise SimulatorError(
                        f"{self._topic}: {part}.{axis} is {number}, expected a finite number: the simulator diverged"
                    )
        q = pose.orientation
        norm = math.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2)
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise SimulatorError(f"{self._topic}: the orientation has the norm {norm:.3g}, expected a unit quaternion")


def _angles(q: Any) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a unit quaternion, rad (REP-103)."""
    roll = math.atan2(2.0 * (q.w * q.x + q.y * q.z), 1.0 - 2.0 * (q.x**2 + q.y**2))
    pitch = math.asin(min(max(2.0 * (q.w * q.y - q.z * q.x), -1.0), 1.0))
    return roll, pitch, math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))


def _in_road(x: float, y: float, origin: OriginSettings) -> tuple[float, float]:
    """Convert a position, m, from the odometry's frame to the road frame."""
    cos, sin = math.cos(origin.yaw), math.sin(origin.yaw)
    x, y = x - origin.x, y - origin.y
    return cos * x + sin * y, cos * y - sin * x


class RosWorld(Vehicle, Scene):
    """Vehicle and scene of another simulator: `ds_sim.parts.Vehicle` and `ds_sim.parts.Scene` on one connection."""

    def __init__(self, settings: RosSettings, camera: CameraSpec, folder: Path) -> None:
        super().__init__(camera)
        way = settings.road
        self.track: Road | None = None  # where it is fixed
        if way.centre_line:
            self.track, moved = read_track(folder / way.centre_line, way.lane_width, way.lane)
            settings = settings.model_copy(update={"origin": settings.origin.of_moved(moved)})
        self._settings, self._folder = settings, folder
        self._speed = 0.0
        self._reader = OdometryReader(settings)
        self._link: Link | None = None
        self._request: tuple[Road, int] | None = None
        self._state: VehicleState | None = None
        self.latency: tuple[float, float] | None = None

    def choose(self, road: Road, seed: int) -> None:
        """Set road and seed of the next run; RoadError if the track is fixed, and the road another one."""
        if self.track is not None:
            check_is_track(road, self.track, self._settings.name)
        self._request = road, seed

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Load the chosen road there, with the vehicle at rest at its start; see `Vehicle.reset`."""
        if self._request is None:
            raise SimulatorError(f"{self._settings.name}: no road is chosen: load one")
        self._speed = 0.0
        road, seed = self._request
        if self._link is not None and not self._link.is_alone:
            self.close()  # the simulator was started anew, which a new connection sees without the old one
        self._ask(lambda link: self._begin(link, road, seed))

    def advance(self, command: Command) -> None:
        """Pass one frame there; see `Vehicle.advance`."""
        self._speed = self._settings.command.speed_after(self._speed, command.throttle)
        self._ask(lambda link: self._take(link.advance(command, self._speed), command.steering))

    def state(self) -> VehicleState:
        """State at the end of the last frame; SimulatorError without a loaded road."""
        if self._state is None:
            raise SimulatorError(f"{self._settings.name}: no road is loaded: load one first")
        return self._state

    def load(self, road: Road, rng: np.random.Generator, conditions: Conditions = DEFAULT) -> None:
        """Do nothing: `reset` has loaded the road."""

    def image(self, state: VehicleState) -> NDArray[np.uint8]:
        """Whole image at the end of the last frame."""
        return self._image

    def still(self, state: VehicleState, rng: np.random.Generator | None = None) -> NDArray[np.uint8]:
        """Whole image at the end of the last frame; SimulatorError for another pose, where no camera can be put."""
        if state != self._state:
            raise SimulatorError(f"{self._settings.name} shows only what its vehicle sees now: drive there")
        return self._image

    def release(self) -> None:
        """Let other runs have the simulator."""
        if self._link is not None:
            self._link.release()

    def close(self) -> None:
        """End the connection; `reset` makes a new one."""
        link, self._link = self._link, None
        if link is not None:
            link.release()
            link.close()

    def _ask(self, act: Callable[[Link], Answer]) -> Answer:
        """Use the connection; one that failed is not used again, as its simulator may be another when it comes back."""
        try:
            if self._link is None:
                from ds_sim_ros.ros.link import Link  # needs ROS

                self._link = Link(self._settings, self._folder)
            return act(self._link)
        except SimulatorError as error:
            self.close()
            raise SimulatorError(f"{self._settings.name}: {error}") from None

    def _begin(self, link: Link, road: Road, seed: int) -> None:
        x, y, yaw = start_of(road)

        def at_start(message: Any) -> bool:
            self._reader.begin(message, yaw)
            return _is_at_rest(self._reader.state(message, 0.0), x, y, yaw)

        received = link.begin(road, seed, at_start)
        self._reader.begin(received[0].message, yaw)
        self._take(received, 0.0)
        state = self.state()
        if not _is_at_rest(state, x, y, yaw):
            raise SimulatorError(
                f"the run begins at x {state.x:.2f}, y {state.y:.2f}, yaw {state.yaw:.2f} with {state.speed:.2f} m/s, "
                f"expected x {x:.2f}, y {y:.2f}, yaw {yaw:.2f} at rest: put the vehicle there, or correct origin"
            )

    def _take(self, received: tuple[Any, Any], steering: float) -> None:
        odometry, image = received
        self._state = self._reader.state(odometry.message, steering)
        self._image = image_of(image.message, self._settings.image)
        assert self._link is not None
        self.latency = self._link.latency


def _is_at_rest(state: VehicleState, x: float, y: float, yaw: float) -> bool:
    near = math.hypot(state.x - x, state.y - y) <= START_DISTANCE and abs(state.yaw - yaw) <= START_ANGLE
    return near and math.hypot(state.speed, state.lateral_speed) <= START_SPEED


class RosSimulator(RoadSimulator):
    """Simulator that a file in a folder describes; it is looked for when the first road is loaded."""

    needs_file = True
    is_external = True

    def __init__(self, settings: RosSettings, folder: Path = Path()) -> None:
        geometry = settings.camera or CameraSettings()
        camera = CameraSpec(**geometry.model_dump())
        gains = settings.autopilot.model_dump()
        spec = SimulatorSpec(
            name=settings.name,
            physics="another simulator's, driven through ROS 2",
            vehicle_length=settings.vehicle.length,
            vehicle_width=settings.vehicle.width,
            wheelbase=settings.vehicle.wheelbase,
            max_steering_angle=settings.vehicle.max_steering_angle,
            camera=camera,
            look=LOOK,
            crop_top=settings.crop_top,
            crop_bottom=settings.crop_bottom,
            preview_distance=gains.pop("preview_distance"),
            autopilot=AutopilotGains(**gains),
            extra={
                "time": NOT_REPEATABLE if settings.time is None else f"lock-step of {settings.time.per_frame} steps",
                "camera": "geometry unknown" if settings.camera is None else "geometry as the file has it",
            },
        )
        self._world = RosWorld(settings, camera, folder)
        super().__init__(spec, self._world, scene=self._world)

    @classmethod
    def from_file(cls, path: Path) -> RosSimulator:
        """Make the simulator that a file describes; RosSettingsError if it, or a file that it names, cannot be used."""
        return cls(read_settings(path), path.parent)

    @property
    def spec(self) -> SimulatorSpec:
        """Description of this simulator; in real time with the largest latencies of the last run."""
        spec, latency = super().spec, self._world.latency
        if latency is None:
            return spec
        late, age = (f"{1000 * seconds:.0f} ms" for seconds in latency)
        return replace(spec, extra=spec.extra | {"latency": f"frames up to {late} late, images up to {age} old"})

    @property
    def own_road(self) -> Road | None:
        """The fixed track; see `Simulator.own_road`."""
        return self._world.track

    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        """Load a road there; see `Simulator.load`."""
        self._world.choose(road, seed)
        return super().load(road, seed=seed, conditions=conditions)

    def step(self, command: Command) -> Observation:
        """Advance by one step; see `Simulator.step`."""
        observation = super().step(command)
        if observation.outcome is not Outcome.RUNNING:
            self._world.release()
        return observation

    def unload(self) -> None:
        """Forget the road once its run has ended, and let other runs have the simulator."""
        super().unload()
        self._world.release()
