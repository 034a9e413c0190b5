# SPDX-License-Identifier: Apache-2.0
"""Rigid-body simulator: the car, a camera behind the windscreen, the look of a sunny day."""

from __future__ import annotations

import math
from importlib import metadata

from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_RATE, AutopilotGains, SimulatorSpec
from ds_sim_bullet.parameters import BulletParameters
from ds_sim_bullet.vehicle import BulletVehicle

PREVIEW_DISTANCE = 3.0
"""Distance of the autopilot's preview point, m; chosen: about half a second at 20 km/h; longer ones cut bends."""
GAINS = AutopilotGains(proportional=0.6)
"""Chosen by driving random roads; the preview replaces the derivative term."""
CAMERA = CameraSpec(
    # Chosen: a wide angle that keeps the lane in view on the inside of a sharp bend.
    horizontal_fov=math.radians(100.0),
    # Chosen: behind the windscreen of a car 1.54 m high, below the mirror.
    height=1.35,
    forward=0.4,
    pitch=math.radians(10.0),
    # Chosen: a good sensor in daylight.
    noise=1.5,
)
LOOK = Look(
    asphalt=(98, 98, 100),
    grass=(96, 132, 60),
    edge_line=(240, 240, 240),
    centre_line=(228, 196, 52),
    sky_top=(98, 156, 226),
    horizon=(196, 216, 236),
    asphalt_grain=5.0,
    grass_grain=14.0,
    grain_seed=2,
    # Chosen: a clear morning, low wooded hills.
    relief=5.0,
    sun_azimuth=math.radians(130.0),
    sun_elevation=math.radians(35.0),
    sun_glow=55.0,
    hills=4.0,
    hill_colour=(92, 122, 104),
)


class BulletSimulator(RoadSimulator):
    """Simulator of a rigid-body city car in PyBullet."""

    modules = ("pybullet",)

    def __init__(self) -> None:
        parameters = BulletParameters()
        spec = SimulatorSpec(
            name="bullet",
            physics="rigid bodies: sprung car on four wheels with Coulomb friction, rear-driven",
            vehicle_length=parameters.length,
            vehicle_width=parameters.width,
            wheelbase=parameters.wheelbase,
            max_steering_angle=parameters.max_steering_angle,
            camera=CAMERA,
            look=LOOK,
            crop_top=54,
            crop_bottom=0,
            autopilot=GAINS,
            preview_distance=PREVIEW_DISTANCE,
            engine=f"PyBullet {metadata.version('pybullet')}",
            extra={"physics_rate": f"{FRAME_RATE * parameters.substeps:g} Hz"},
        )
        super().__init__(spec, BulletVehicle(parameters))
