# SPDX-License-Identifier: Apache-2.0
"""Panda simulator: the multi-body car in a world rendered by Panda3D."""

from __future__ import annotations

import math
from importlib.metadata import version

from ds_base.installation import versions
from ds_sim.camera.spec import CameraSpec, Look
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import SimulatorError, SimulatorSpec
from ds_sim_panda.scene.graphics import graphics
from ds_sim_panda.scene.panda_scene import PandaScene
from ds_sim_panda.vehicle.multi_body import MultiBodyVehicle
from ds_sim_panda.vehicle.parameters import GAINS, PREVIEW_DISTANCE, MultiBodyParameters

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
