# SPDX-License-Identifier: Apache-2.0
"""Soft-body simulator: the car of frame, wheels and body, a camera at the front bumper, the look of an overcast day."""

from __future__ import annotations

import math
from ctypes import c_double, c_void_p
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.machine_code import load, values
from ds_sim.parts import VEHICLE_CONDITIONS, Vehicle
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_TIME, AutopilotGains, Command, SimulatorError, SimulatorSpec, VehicleState
from ds_sim_softbody.lattice import ENGINE_FUNCTIONS, CornerNodes, Lattice, blueprint
from ds_sim_softbody.parameters import GRAVITY, SoftbodyParameters
from ds_sim_softbody.parts import CAR, Actuators, Attitude, Wheel, carry, shift

PREVIEW_DISTANCE = 4.0
"""Distance of the autopilot's preview point ahead of the car's centre, m; chosen: about 0.6 s at 23 km/h."""
GAINS = AutopilotGains(proportional=0.4)
"""Chosen by driving random roads; the preview replaces the derivative term."""
CAMERA = CameraSpec(
    # maxitwo, BeamNG: 120 degrees, 1.7 m forward and 1.0 m up, looking straight ahead; chosen: 3 degrees down.
    horizontal_fov=math.radians(120.0),
    height=1.0,
    forward=1.7,
    pitch=math.radians(3.0),
    # Chosen: an overcast day and a clean rendered image.
    gain=0.90,
    gamma=1.05,
    noise=1.0,
)
LOOK = Look(
    asphalt=(62, 62, 64),
    grass=(66, 84, 44),
    edge_line=(214, 214, 210),
    centre_line=(200, 164, 44),
    sky_top=(112, 140, 176),
    horizon=(178, 190, 198),
    asphalt_grain=7.0,
    grass_grain=18.0,
    grain_seed=7,
    # Chosen: overcast, so no sun and no relief; a row of trees.
    sun_azimuth=math.radians(-60.0),
    sun_glow=14.0,
    hills=6.0,
    hill_colour=(70, 84, 74),
    skyline="trees",
)


def _wheel_at_rest(p: SoftbodyParameters, corner: CornerNodes, nodes: NDArray[np.float64], *, front: bool) -> Wheel:
    """Track rods ahead of the front wheels' axis and toe links behind the rear wheels' axis: both add understeer."""
    share = p.front_share if front else 1.0 - p.front_share
    wheel = Wheel(
        node=corner.wheel,
        fore=corner.fore,
        aft=corner.aft,
        static_load=p.mass * GRAVITY * share / 2.0,
        cornering_stiffness=p.front_cornering_stiffness if front else p.rear_cornering_stiffness,
        toe_per_shift=-1.0 / p.front_arm if front else 1.0 / p.rear_arm,
        spin_inertia=p.wheel_spin_inertia + (0.0 if front else p.rotor_inertia),
    )
    wheel.rest = shift(wheel, nodes, 1.0, 0.0)
    carry(wheel, p, wheel.static_load)
    return wheel


class SoftbodyVehicle(Vehicle):
    """Car of nodes and beams on an infinite plane.

    The physics run in the car's axes at the start, so that a run does not depend on where it starts.
    """

    conditions = VEHICLE_CONDITIONS

    def __init__(self, parameters: SoftbodyParameters | None = None) -> None:
        self._nominal = self.parameters = parameters or SoftbodyParameters()
        self._plan = blueprint(self.parameters)
        self._lattice: Lattice | None = None

    def adjust(self, *, friction: float, payload: float) -> None:
        """Change grip and load for the runs to come; see `Vehicle.adjust`."""
        parameters = self._nominal.adjusted(friction=friction, payload=payload)
        if parameters != self.parameters:
            self.parameters, self._plan = parameters, blueprint(parameters)

    def reset(self, x: float, y: float, yaw: float, rng: np.random.Generator) -> None:
        """Build the car from scratch, at rest with its centre at (x, y), m, heading yaw (rad); `rng` is not used."""
        self._start = (x, y, yaw)
        p, self.record = self.parameters, np.zeros(1, CAR)
        car = self.record[0]
        lattice = self._lattice = Lattice(self._plan, car["nodes"], iterations=p.solver_iterations)
        wheels = [_wheel_at_rest(p, corner, car["nodes"], front=i < 2) for i, corner in enumerate(self._plan.corners)]
        car["parameters"], car["wheels"] = values(p), [values(wheel) for wheel in wheels]
        car["actuators"], car["attitude"] = values(Actuators()), values(Attitude.at_rest(p))
        car["space"], car["each_body"], car["request"], car["bodies"] = lattice.addresses
        self._advance = load(
            "ds_sim_softbody.advance", c_void_p, c_void_p, c_double, c_double, symbols=ENGINE_FUNCTIONS
        )
        self._motion = lattice.rigid_motion()

    def advance(self, command: Command) -> None:
        """Advance by one step of 1/20 s with the command held."""
        lattice = self._running()
        self._advance(self.record.ctypes.data, lattice.values_read, command.steering, command.throttle)
        lattice.read()
        motion = lattice.rigid_motion()
        turned = math.remainder(motion.yaw - self._motion.yaw, math.tau)
        self._motion = motion._replace(yaw=self._motion.yaw + turned)  # counts full turns

    def state(self) -> VehicleState:
        """State of the midpoint between the axles, of the undeformed frame fitted to the nodes."""
        self._running()
        motion, car = self._motion, self.record[0]
        x, y, yaw = self._start
        cos, sin = math.cos(yaw), math.sin(yaw)
        own_cos, own_sin = math.cos(motion.yaw), math.sin(motion.yaw)
        left, right, *_ = car["wheels"]  # whose mean angle includes the flex of the frame
        wheels = math.atan2(left["heading_y"] + right["heading_y"], left["heading_x"] + right["heading_x"])
        return VehicleState(
            x=x + motion.x * cos - motion.y * sin,
            y=y + motion.x * sin + motion.y * cos,
            yaw=yaw + motion.yaw,
            speed=motion.velocity_x * own_cos + motion.velocity_y * own_sin,
            lateral_speed=motion.velocity_y * own_cos - motion.velocity_x * own_sin,
            yaw_rate=motion.yaw_rate,
            steering_angle=math.remainder(wheels - motion.yaw, math.tau),
            roll=float(car["attitude"]["roll"]),
            pitch=float(car["attitude"]["pitch"]),
        )

    def close(self) -> None:
        """Release the frame; `reset` may follow."""
        self._lattice = None

    def _running(self) -> Lattice:
        if self._lattice is None:
            raise SimulatorError("the soft car has not been placed yet: call reset first")
        return self._lattice


class SoftbodySimulator(RoadSimulator):
    """Simulator of a small electric car of nodes and damped beams."""

    def __init__(self) -> None:
        p = SoftbodyParameters()
        spec = SimulatorSpec(
            name="softbody",
            physics="soft body: mass nodes joined by damped beams, brush tyres at the wheel nodes",
            vehicle_length=p.length,
            vehicle_width=p.width,
            wheelbase=p.wheelbase,
            max_steering_angle=p.max_steering_angle,
            camera=CAMERA,
            look=LOOK,
            # maxitwo, BeamNG: rows 80 to -1.
            crop_top=80,
            crop_bottom=1,
            autopilot=GAINS,
            preview_distance=PREVIEW_DISTANCE,
            engine=f"pymunk {version('pymunk')} at {p.frame_substeps / FRAME_TIME:g} Hz",
        )
        super().__init__(spec, SoftbodyVehicle(p))
