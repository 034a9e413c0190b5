# SPDX-License-Identifier: Apache-2.0
"""Soft-body simulator: the car, a camera at the front bumper, the look of an overcast day."""

from __future__ import annotations

import math
from importlib.metadata import version

from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_TIME, AutopilotGains, SimulatorSpec
from ds_sim_softbody.parameters import SoftbodyParameters
from ds_sim_softbody.vehicle import SoftbodyVehicle

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
    line_width=0.15,
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
