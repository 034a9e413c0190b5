"""The soft-body sibling as a simulator: the car, its camera on the bonnet and the look of a dull day."""

from __future__ import annotations

import math
from importlib import metadata

from ds_sim.camera_spec import CameraSpec
from ds_sim.look import Look
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_RATE, AutopilotGains, SimulatorSpec
from ds_sim_softbody.parameters import SoftbodyParameters
from ds_sim_softbody.vehicle import SoftbodyVehicle

PREVIEW_DISTANCE = 4.0
"""m; chosen: about two thirds of a second at 22 km/h."""
GAINS = AutopilotGains(proportional=0.5)
"""Chosen by driving random roads; the preview stands in for the derivative."""
CAMERA = CameraSpec(
    # maxitwo's BeamNG camera: 120 degrees, 1.7 m before the vehicle's reference, 1.0 m high, looking straight ahead.
    horizontal_fov=math.radians(120.0),
    height=1.0,
    forward=1.7,
    # Chosen: a little down, so that less of the image is sky.
    pitch=math.radians(4.0),
    # Chosen: dull light.
    gain=0.95,
    noise=2.5,
)
LOOK = Look(
    asphalt=(74, 76, 80),
    grass=(70, 104, 48),
    edge_line=(216, 218, 216),
    centre_line=(206, 168, 40),
    sky_top=(150, 164, 182),
    horizon=(188, 198, 206),
    line_width=0.15,
    asphalt_grain=8.0,
    grass_grain=18.0,
    grain_seed=3,
)


class SoftbodySimulator(RoadSimulator):
    """A small car of nodes and beams in pymunk.

    Args:
        parameters: of the car; the nominal ones if left out.
    """

    def __init__(self, parameters: SoftbodyParameters | None = None) -> None:
        parameters = parameters or SoftbodyParameters()
        spec = SimulatorSpec(
            name="softbody",
            physics="mass nodes and damped beams on four slipping tyres, with load transfer and body attitude",
            vehicle_length=parameters.length,
            vehicle_width=parameters.width,
            wheelbase=parameters.wheelbase,
            max_steering_angle=parameters.max_steering_angle,
            camera=CAMERA,
            look=LOOK,
            crop_top=66,
            crop_bottom=0,
            autopilot=GAINS,
            preview_distance=PREVIEW_DISTANCE,
            engine=f"pymunk {metadata.version('pymunk')}",
            extra={"physics_rate": f"{FRAME_RATE * parameters.substeps:g} Hz"},
        )
        super().__init__(spec, SoftbodyVehicle(parameters))
