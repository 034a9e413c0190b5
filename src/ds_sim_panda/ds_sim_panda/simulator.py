"""Panda simulator: the multi-body car in a world rendered by Panda3D."""

from __future__ import annotations

import math
from importlib.metadata import version

from ds_sim.camera.look import Look
from ds_sim.camera.spec import CameraSpec
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import FRAME_TIME, SimulatorSpec
from ds_sim_panda.scene.panda_scene import PandaScene

CAMERA = CameraSpec(
    # Chosen: the usual wide angle of dashboard cameras; a pinhole image stretches its borders by no more than sqrt(2).
    horizontal_fov=math.radians(90.0),
    # Chosen: behind the windscreen of a saloon 1.42 m high, below the mirror.
    height=1.25,
    forward=0.3,
    # Chosen: the horizon at a third of the image's height, so that most of it shows the road.
    pitch=math.radians(8.0),
)
