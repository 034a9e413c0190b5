"""Ground as a disc of rings that follows the camera, so that it has no border in view."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ds_sim_panda.scene.meshes import VERTEX, mesh_node, strip_triangles
from ds_sim_panda.scene.parameters import GROUND_RADIUS

_SECTORS = 24
_RADII = (0.0, 4.0, 12.0, 36.0, 108.0, 324.0, 972.0, 2916.0, 8748.0, GROUND_RADIUS)
"""Of the rings, m; chosen: no triangle near the camera is so large that positions on it lose precision."""
_NEAR = 5
"""Number of radii of the part on which no pixel reaches the horizon."""


def ground_rings(*, far: bool) -> Any:
    """Panda3D's node of the ground near the origin, or of the rest around it."""
    radii = np.array(_RADII[_NEAR - 1 :] if far else _RADII[:_NEAR])
    azimuths = np.linspace(0.0, math.tau, _SECTORS + 1)
    vertices = np.zeros((len(radii), len(azimuths)), VERTEX)
    vertices["position"][..., 0] = radii[:, None] * np.cos(azimuths)
    vertices["position"][..., 1] = radii[:, None] * np.sin(azimuths)
    return mesh_node("far ground" if far else "ground", vertices.reshape(-1), strip_triangles(*vertices.shape))
