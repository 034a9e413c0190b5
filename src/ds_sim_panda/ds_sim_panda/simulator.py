# SPDX-License-Identifier: Apache-2.0
"""Panda simulator: the multi-body car in a world rendered by Panda3D."""

from __future__ import annotations

import math
from importlib.metadata import version
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.installation import versions
from ds_road import Road
from ds_sim.camera.lens import optical_axes
from ds_sim.camera.optics import CAMERA_CONDITIONS
from ds_sim.camera.rendered_scene import RenderedScene
from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.parts import VEHICLE_CONDITIONS, Vehicle
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_TIME, Command, SimulatorError, SimulatorSpec, VehicleState
from ds_sim_panda.scene.graphics import graphics, panda
from ds_sim_panda.scene.parameters import FAR, NEAR
from ds_sim_panda.scene.setting import WORLD_CONDITIONS, Setting, sun_direction
from ds_sim_panda.scene.world import World
from ds_sim_panda.vehicle import parameters as model
from ds_sim_panda.vehicle.parameters import GAINS, PREVIEW_DISTANCE, MultiBodyParameters

SETTLING_FRAMES = 200
"""Frames at rest in which the car settles on its springs; chosen: 10 s, fifteen periods of the body."""
LIBRARIES = ("panda3d", "commonroad-vehicle-models")
CAMERA = CameraSpec(
    # Chosen: the wide angle of a dashboard camera, at which a pinhole image is stretched by sqrt(2) at its sides.
    horizontal_fov=math.radians(90.0),
    # Chosen: behind the windscreen of a compact car 1.4 m high, below the mirror.
    height=1.25,
    forward=0.3,
    # Chosen: the horizon lies at a third of the image's height, so that most of it shows the road.
    pitch=math.radians(8.0),
)
MARKER_COLOURS = Look(asphalt=(88, 88, 90), grass=(78, 112, 48), edge_line=(230, 230, 225), centre_line=(214, 152, 32))
"""Colours of the road in RViz; the images have those of `scene/parameters.py`."""


class MultiBodyVehicle(Vehicle):
    """Car with 29 states on an infinite plane.

    The model runs in the car's axes at the start, so that a run does not depend on where it starts.
    """

    conditions = VEHICLE_CONDITIONS

    def __init__(self, parameters: MultiBodyParameters | None = None) -> None:
        model.check_version()
        from ds_sim_panda.vehicle.integration import advance  # imports Numba, which takes most of a second

        self.parameters = parameters or MultiBodyParameters()
        self._integrate = advance
        self._adjusted = (1.0, 0.0)
        self._settle()
        self._x: np.ndarray | None = None
        self._start = (0.0, 0.0, 0.0)

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change grip and load for the runs to come; see `Vehicle.adjust`."""
        if (friction, payload) != self._adjusted:
            self._adjusted = (friction, payload)
            self._settle()

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Place the car at rest with its centre at (x, y), m, heading yaw (rad); `rng` is not used."""
        self._start = (x, y, yaw)
        self._x = self._rest.copy()
        self._x[model.X] = self.parameters.centre_of_mass_ahead

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held."""
        self._advance(self._running(), command)

    def state(self) -> VehicleState:
        """State of the midpoint between the axles."""
        s = self._running()
        ahead = self.parameters.centre_of_mass_ahead
        yaw = float(s[model.YAW])
        cos, sin = math.cos(yaw), math.sin(yaw)
        # The axles' midpoint in the axes at the start: the sprung mass leans over it on compliant joints.
        offset = 0.5 * (s[model.FRONT_OFFSET] + s[model.REAR_OFFSET])
        x = float(s[model.X] - ahead * cos + offset * sin)
        y = float(s[model.Y] - ahead * sin - offset * cos)
        start_x, start_y, start_yaw = self._start
        start_cos, start_sin = math.cos(start_yaw), math.sin(start_yaw)
        pitch = float(self._rest[model.PITCH] - s[model.PITCH])
        return VehicleState(
            x=start_x + x * start_cos - y * start_sin,
            y=start_y + x * start_sin + y * start_cos,
            yaw=start_yaw + yaw,
            speed=float(s[model.SPEED]),
            lateral_speed=0.5 * float(s[model.FRONT_LATERAL_SPEED] + s[model.REAR_LATERAL_SPEED]),
            yaw_rate=float(s[model.YAW_RATE]),
            steering_angle=float(s[model.STEERING]),
            roll=-float(s[model.ROLL]),
            pitch=pitch,
            heave=float(self._rest[model.HEAVE] - s[model.HEAVE]) + ahead * math.sin(pitch),
        )

    def close(self) -> None:
        """Release the state; `reset` may follow."""
        self._x = None

    def _settle(self) -> None:
        """Make the car with its grip and load, at rest on its springs."""
        p, (friction, payload) = self.parameters, self._adjusted
        car, grown = p.published, 1.0 + payload
        tyre = {"r_vy1": p.slip_side_force}
        changed: dict[str, Any] = {}
        if friction != 1.0:
            # Peak friction of the Magic Formula; its stiffness, and so the feel below the limit, stays.
            tyre |= {"p_dx1": friction * car.tire.p_dx1, "p_dy1": friction * car.tire.p_dy1}
        if payload:
            sprung = (car.m_s + payload * car.m) / car.m_s
            changed = {"m": grown * car.m, "m_s": sprung * car.m_s, "I_z": grown * car.I_z}
            changed |= {name: sprung * getattr(car, name) for name in ("I_Phi_s", "I_y_s", "I_xz_s")}
        self._car: Any = model.record(car, tire=tyre, **changed)
        # The published input is an acceleration: the motor's force stays that of the car without load.
        self._law: Any = model.record(
            p,
            slip_rate=p.slip_rate * grown,
            drive_acceleration=p.drive_acceleration / grown,
            regenerative_deceleration=p.regenerative_deceleration / grown,
        )
        self._rest = model.rest_state(p.parameter_set)
        for _ in range(SETTLING_FRAMES):
            self._advance(self._rest, Command(0.0, 0.0))

    def _advance(self, state: np.ndarray, command: Command) -> None:
        p = self.parameters
        # The sign of the command is that of the paper, right positive.
        self._integrate(
            state,
            -float(command.steering) * p.max_steering_angle,
            float(command.throttle),
            FRAME_TIME,
            p.substeps,
            self._car,
            self._law,
        )

    def _running(self) -> np.ndarray:
        if self._x is None:
            raise SimulatorError("the multi-body car has not been placed yet: call reset first")
        return self._x


class PandaScene(RenderedScene):
    """Implements `ds_sim.parts.Scene` with Panda3D: textured meshes, shadows of the sun, haze; for a pinhole camera."""

    conditions = WORLD_CONDITIONS | CAMERA_CONDITIONS

    def __init__(self, camera: CameraSpec) -> None:
        super().__init__(camera)
        graphics()
        lens, half = panda().PerspectiveLens(), math.tan(camera.horizontal_fov / 2)
        across, down = camera.horizontal_fov, 2 * math.atan(half * camera.height_px / camera.width)  # square pixels
        lens.set_fov(math.degrees(across), math.degrees(down))
        lens.set_near_far(NEAR, FAR)
        self._camera = panda().NodePath(panda().Camera("camera", lens))
        self._world: World | None = None
        x, y, z = sun_direction(DEFAULT)
        self.sun = math.atan2(y, x), math.asin(z)

    def close(self) -> None:
        """Release the world; `load` may follow."""
        super().close()
        self._world = None

    def _build(self, road: Road, conditions: Conditions, rng: np.random.Generator) -> None:
        self._world = None
        changed = WORLD_CONDITIONS & conditions.changed.keys()
        self._world = World(road, Setting(conditions, rng) if changed else None)

    def _render(self, state: VehicleState, rows: tuple[int, int]) -> NDArray[np.uint8]:
        world, spec = self._world, self._run_spec
        if world is None:
            raise SimulatorError("the scene has no road: load one first")
        (right, down, forward), (x, y, z) = optical_axes(spec, state)
        place = (x - float(world.origin[0]), y - float(world.origin[1]), z)
        pose = (*right, 0.0, *forward, 0.0, *(-v for v in down), 0.0, *place, 1.0)  # right, forward, up and position
        self._camera.reparent_to(world.root)
        self._camera.set_mat(panda().LMatrix4(*pose))
        world.follow(*place)
        top, bottom = rows
        drawn = graphics().draw(self._camera, spec.width, spec.height_px, top=top)[::-1]
        image = np.zeros((spec.height_px, spec.width, 3), np.uint8)
        cv2.cvtColor(drawn[: bottom - top], cv2.COLOR_BGR2RGB, image[top:bottom])
        return image


class PandaSimulator(RoadSimulator):
    """Simulator of a compact car with CommonRoad's multi-body model in a world rendered by Panda3D.

    Raises:
        ImportError: a library of this simulator is not installed.
        ds_sim.simulator.SimulatorError: EGL or Mesa's software renderer is missing.
    """

    modules = ("panda3d", "vehiclemodels")

    @classmethod
    def depends_on(cls) -> dict[str, str]:
        """Versions of the libraries that move the car and draw; the renderer is "absent" where it cannot draw."""
        try:
            renderer = graphics().renderer
        except (ImportError, SimulatorError):
            renderer = "absent"
        return {**{name: versions()[name] for name in LIBRARIES}, "renderer": renderer}

    def __init__(self) -> None:
        p = MultiBodyParameters()
        scene = PandaScene(CAMERA)
        spec = SimulatorSpec(
            name="panda",
            physics="multi-body: 29 states, sprung and unsprung masses, Magic Formula tyres (CommonRoad)",
            vehicle_length=float(p.published.l),
            vehicle_width=float(p.published.w),
            wheelbase=p.wheelbase,
            max_steering_angle=p.max_steering_angle,
            camera=CAMERA,
            look=MARKER_COLOURS,
            # maxitwo, Donkey: rows 60 to the end, here from just below the horizon.
            crop_top=60,
            crop_bottom=0,
            autopilot=GAINS,
            preview_distance=PREVIEW_DISTANCE,
            engine=f"commonroad-vehicle-models {version('commonroad-vehicle-models')}, Panda3D {version('panda3d')} on "
            f"{graphics().renderer}",
        )
        super().__init__(spec, MultiBodyVehicle(p), scene=scene)
