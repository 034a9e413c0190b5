# SPDX-License-Identifier: Apache-2.0
"""TORCS simulator: a car of TORCS in a world that TORCS renders."""

from __future__ import annotations

import math

from ds_sim.camera.spec import CameraSpec
from ds_sim.registry import UnknownSimulatorError, spec_of
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_RATE, SimulatorError, SimulatorSpec
from ds_sim_torcs.host import VERSION, TorcsHost, host_program
from ds_sim_torcs.parameters import CAR, GAINS, PREVIEW_DISTANCE, SUBSTEPS, TorcsParameters
from ds_sim_torcs.scene import LOOK, TorcsScene
from ds_sim_torcs.vehicle import TorcsVehicle

CAMERA = CameraSpec(
    # Chosen: between `panda` and `bullet`; it keeps the lane in view on the inside of a sharp bend.
    horizontal_fov=math.radians(95.0),
    # Chosen: behind the windscreen of a saloon 1.2 m high, below the mirror.
    height=1.1,
    forward=0.5,
    # Chosen: the horizon lies at a third of the image's height, so that most of it shows the road.
    pitch=math.radians(9.0),
)


class TorcsSimulator(RoadSimulator):
    """Simulator of a saloon in TORCS's physics, in a world rendered by TORCS.

    Args:
        parameters: parameters of the car; nominal values if omitted.

    Raises:
        ImportError: TORCS or its host is missing.
        ds_sim.simulator.SimulatorError: the host does not start.
    """

    @classmethod
    def missing(cls) -> str:
        """TORCS or its host; "" where both are there."""
        try:
            host_program()
        except ImportError as error:
            return str(error)
        return ""

    @classmethod
    def depends_on(cls) -> dict[str, str]:
        """Versions of TORCS and of the library that draws for it; "absent" where it is not built."""
        try:
            return {"TORCS": spec_of("torcs").engine}
        except (UnknownSimulatorError, SimulatorError):
            return {"TORCS": "absent"}

    def __init__(self, parameters: TorcsParameters | None = None) -> None:
        p = parameters or TorcsParameters()
        host = TorcsHost(CAMERA.width, CAMERA.height_px)
        spec = SimulatorSpec(
            name="torcs",
            physics="TORCS's simuv2: a sprung body, Magic Formula tyres, engine, gearbox, three differentials",
            vehicle_length=p.length,
            vehicle_width=p.width,
            wheelbase=p.wheelbase,
            max_steering_angle=p.max_steering_angle,
            camera=CAMERA,
            look=LOOK,
            # maxitwo, Donkey: rows 60 to the end, here from just below the horizon.
            crop_top=60,
            crop_bottom=0,
            autopilot=GAINS,
            preview_distance=PREVIEW_DISTANCE,
            engine=f"TORCS {VERSION} (simuv2, ssggraph) on {host.renderer()}",
            extra={"car": CAR, "physics_rate": f"{FRAME_RATE * SUBSTEPS:g} Hz"},
        )
        super().__init__(spec, TorcsVehicle(host, p), scene=TorcsScene(host, CAMERA))
