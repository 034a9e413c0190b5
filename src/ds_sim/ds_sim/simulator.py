# SPDX-License-Identifier: Apache-2.0
"""Interface between a simulator and everything else: commands, observations, outcomes.

Coordinates and units: metres, seconds, radians; the road frame has x and y in the plane, z up, and yaw
counter-clockwise from +x (REP-103). Steering is the one exception, as in the paper (section 3.2.1): -1 full left,
+1 full right.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import IntEnum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError, RunError
from ds_base.installation import missing_module
from ds_road import Road
from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.conditions.model import DEFAULT, Conditions, NotApplicableError

if TYPE_CHECKING:
    from ds_sim.registry import SimulatorName

FRAME_RATE = 20.0
"""Camera frames per simulated second (paper 3.2.1: all simulators aligned at 20 fps)."""
FRAME_TIME = 1.0 / FRAME_RATE
MAX_SPEED = 30.0 / 3.6
"""Speed limit, m/s (paper 4.2.4: 30 km/h in all simulators)."""


class CommandError(InputError):
    """A command that no vehicle can execute."""


class SimulatorError(RunError):
    """A simulator cannot continue; the run ends as an error, never as a failure of the driver."""


class OutOfSightError(SimulatorError):
    """The driver went where the simulator cannot show what it would see: neither a failure nor worth another try."""


class Reason(IntEnum):
    """Why a request was refused, or why a run ended without a verdict. Values of ds_interfaces/msg/Reason."""

    NONE = 0
    BAD_ROAD = 1
    BAD_GOAL = 2
    NO_ROAD = 3
    BUSY = 4
    TWO_SIMULATORS = 5
    TWO_DRIVERS = 6
    COMMAND_REFUSED = 7
    WRONG_STAMP = 8
    RESET = 9
    NOT_APPLICABLE = 10
    TWO_ORCHESTRATORS = 11
    OUT_OF_SIGHT = 12


class Outcome(IntEnum):
    """How a run ended; values as in ds_interfaces/msg/Outcome."""

    RUNNING = 0
    COMPLETED = 1
    OUT_OF_BOUNDS = 2
    STUCK = 3
    TIMEOUT = 4
    DRIVER_SILENT = 5
    SIM_ERROR = 6
    CANCELLED = 7

    def __str__(self) -> str:
        """The name, where an outcome is printed."""
        return self.name

    @property
    def words(self) -> str:
        """For a reader: `out of bounds`."""
        return self.name.lower().replace("_", " ")

    @property
    def is_verdict(self) -> bool:
        """True if the run is a valid test of the driver and may enter a feature map."""
        return Outcome.COMPLETED <= self <= Outcome.TIMEOUT

    @property
    def is_failure(self) -> bool:
        """True if the driver failed the test: out of bounds, stuck or too slow."""
        return self in (Outcome.OUT_OF_BOUNDS, Outcome.STUCK, Outcome.TIMEOUT)

    @property
    def is_error(self) -> bool:
        """True if the run says nothing about the driver and must be repeated."""
        return self > Outcome.TIMEOUT


@dataclass(frozen=True, slots=True)
class Command:
    """Driving command, held for one step.

    Attributes:
        steering: -1 full left to +1 full right (paper 3.2.1).
        throttle: 0 none to 1 full (paper, equation 2).

    Raises:
        CommandError: a value is not a finite number or is out of range.
    """

    steering: float
    throttle: float

    def __post_init__(self) -> None:
        for name, value, low in (("steering", self.steering, -1.0), ("throttle", self.throttle, 0.0)):
            if not (math.isfinite(value) and low <= value <= 1.0):
                raise CommandError(f"{name} is {value}, expected a number from {low:g} to 1: clip it in the driver")


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """Pose and motion of the vehicle in the road frame, in road metres whatever the vehicle's scale.

    Attributes:
        x: position of the vehicle's centre, m.
        y: position of the vehicle's centre, m.
        yaw: heading, rad, counter-clockwise from +x.
        speed: velocity along the heading, m/s.
        lateral_speed: velocity to the left of the heading, m/s.
        yaw_rate: rad/s.
        steering_angle: mean angle of the front wheels, rad, left positive (REP-103).
        roll: rotation of the body about its forward axis, rad, right side down positive (REP-103).
        pitch: rotation of the body about its left axis, rad, nose down positive (REP-103).
        heave: height of the body above its rest position, m.
    """

    x: float
    y: float
    yaw: float
    speed: float
    yaw_rate: float
    steering_angle: float
    lateral_speed: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    heave: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneState:
    """Position of the vehicle relative to its lane (paper 3.3, 4.2.4).

    Attributes:
        lateral_position: signed distance of the vehicle's centre from the driven lane's centre line, m, right positive.
        lateral_distance: half a lane minus |lateral_position|, m; negative out of bounds.
        preview_lateral_position: lateral position of the autopilot's preview point ahead of the vehicle, m.
        arc_length: distance driven along the lane's centre line, m.
    """

    lateral_position: float
    lateral_distance: float
    preview_lateral_position: float
    arc_length: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """One frame: the image that the driver sees, and the ground truth that only the test sees.

    Attributes:
        image: camera image, (160, 320, 3) uint8 RGB, read-only.
        step: steps since the start of the run.
        time: simulated time since the start of the run, s.
        vehicle: state of the vehicle.
        lane: position of the vehicle in its lane.
        outcome: RUNNING until the run ends.
    """

    image: NDArray[np.uint8]
    step: int
    time: float
    vehicle: VehicleState
    lane: LaneState
    outcome: Outcome


@dataclass(frozen=True, kw_only=True)
class SimulatorSpec:
    """Static description of a simulator; lengths in road metres.

    Attributes:
        name: short name, as on the command line.
        physics: one-line description of the physics model.
        vehicle_length: m.
        vehicle_width: m.
        wheelbase: m.
        max_steering_angle: angle of the wheels for |steering| = 1, rad.
        camera: camera and its mounting.
        look: appearance of the world.
        crop_top: image rows cut off at the top before the image enters a network (paper 3.2.2).
        crop_bottom: image rows cut off at the bottom.
        autopilot: gains of the autopilot (paper, equation 1).
        preview_distance: distance of the autopilot's preview point ahead of the vehicle's centre, m.
        engine: name and version of the physics engine.
        conditions: names of the operating conditions that it realises, see `ds_sim.conditions`.
        extra: further properties, name -> value.
    """

    name: str
    physics: str
    vehicle_length: float
    vehicle_width: float
    wheelbase: float
    max_steering_angle: float
    camera: CameraSpec
    look: Look
    crop_top: int
    crop_bottom: int
    autopilot: AutopilotGains
    preview_distance: float
    engine: str = ""
    conditions: tuple[str, ...] = ()
    extra: dict[str, str] = field(default_factory=dict)

    def check(self, conditions: Conditions) -> None:
        """Check that the simulator realises all conditions that are not the default.

        Raises:
            NotApplicableError: it does not; one line with those that it realises.
        """
        missing = [name for name in conditions.changed if name not in self.conditions]
        if missing:
            realised = ", ".join(self.conditions) or "none"
            raise NotApplicableError(f"{self.name} cannot realise {', '.join(missing)}: it realises {realised}")


@dataclass(frozen=True, kw_only=True)
class AutopilotGains:
    """Constants of the paper's equations 1 and 2 for one vehicle.

    Attributes:
        proportional: gain on the lateral position, 1/m (K_P).
        derivative: gain on the difference of two consecutive lateral positions, 1/m (K_D).
        integral: gain on the sum of all lateral positions, 1/m (K_I).
        max_speed: speed threshold and high value K = H of equation 2, km/h.
        min_speed: low value K = L of equation 2, km/h (maxitwo: 15 for every simulator).
    """

    proportional: float
    derivative: float = 0.0
    integral: float = 0.0
    max_speed: float = 30.0
    min_speed: float = 15.0


class Simulator(ABC):
    """Simulates a vehicle with a camera on a road; a run depends on (road, seed, conditions, commands) alone.

    Attributes:
        needs_file: whether it is nothing without the file or folder after `@`, which `from_file` gets.
        is_external: whether it is another program, which has one vehicle however often it is made here, and commands
            whatever listens to it.
        takes_stills: whether it has `still`.
        modules: modules of extras that it needs.
    """

    needs_file: ClassVar[bool] = False
    is_external: ClassVar[bool] = False
    takes_stills: ClassVar[bool] = False
    modules: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def named(cls, name: SimulatorName) -> Simulator:
        """Make the simulator of a name, whose base led to this class."""
        return cls.from_file(Path(name.file)) if name.file else cls()

    @classmethod
    def from_file(cls, path: Path) -> Simulator:
        """Make the simulator that a file or folder after `@` describes; without an override it takes none.

        Raises:
            ds_base.errors.InputError: it takes no file, or the file cannot be used.
        """
        raise InputError(f"{cls.__name__} takes no parameter file: leave out @{path}")

    @classmethod
    def missing(cls) -> str:
        """Say what must be installed before it can be made, one line with what to type; "" if nothing is missing."""
        return next((missing_module(name) for name in cls.modules if find_spec(name) is None), "")

    @classmethod
    def depends_on(cls) -> dict[str, str]:
        """Versions of what, beside code and common libraries, determines the bits of a drive: name -> value."""
        return {}

    @property
    @abstractmethod
    def spec(self) -> SimulatorSpec:
        """Description of this simulator."""

    @abstractmethod
    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        """Build the world from scratch, with the vehicle at rest at the start of the driven lane.

        Args:
            road: a valid road.
            seed: of all random numbers of the run.
            conditions: operating conditions, all of which `spec.conditions` names.

        Returns:
            First observation, at step 0.

        Raises:
            ds_road.RoadError: the road is not valid.
            ds_sim.NotApplicableError: it cannot realise a condition.
        """

    @property
    def own_road(self) -> Road | None:
        """What is driven where no road is named, on a simulator that takes only its own; None if it takes any."""
        return None

    @abstractmethod
    def step(self, command: Command) -> Observation:
        """Advance by one step of 1/20 s simulated time with the command held.

        Raises:
            SimulatorError: no road is loaded, the run has ended, or the physics diverged.
        """

    def draw_rows(self, top: int, bottom: int) -> None:
        """Allow it to draw only some rows of the images of the runs to come; the other rows are zero, or drawn too.

        A row that is drawn holds the same bits as without this call, which holds until the next one. A run in progress
        goes on as it began.

        Args:
            top: first row to draw.
            bottom: end of the rows to draw.

        Raises:
            ValueError: not 0 <= top < bottom <= rows of the image.
        """
        return

    def draw_images(self, wanted: bool) -> None:
        """Allow it to leave out the images from the next one exposed on, or no longer; they are zero, or drawn too.

        Every image that is drawn holds the same bits as without this call. A camera with latency delivers what it
        exposed so many frames before.
        """
        return

    def still(self) -> NDArray[np.uint8]:
        """Take an image of the present state, without sensor noise and latency; the run is not affected.

        Returns:
            (rows, columns, 3) uint8 RGB, of which all rows are drawn, whatever `draw_rows` says.

        Raises:
            SimulatorError: no road is loaded, or it takes no stills.
        """
        raise SimulatorError(f"{self.spec.name} takes no stills")

    def unload(self) -> None:
        """Forget the road once its run has ended, so that other simulators use its memory."""
        return

    def close(self) -> None:
        """Release the simulator's resources; `load` may follow."""
        return
