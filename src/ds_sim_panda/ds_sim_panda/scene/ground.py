"""Ground as a disc of rings that follows the camera, so that it has no border in view."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ds_sim_panda.scene.meshes import VERTEX, mesh_node, strip_triangles
from ds_sim_panda.scene.parameters import GROUND_RADIUS

_SECTORS = 24
_FIRST = 4.0
"""Radius of the innermost ring, m; each is three times as large as the one before: chosen, so that no triangle near the
camera is so large that positions on it lose precision."""


def ground_disc() -> Any:
    """Panda3D's node of the disc, around the origin."""
    count = math.ceil(math.log(GROUND_RADIUS / _FIRST, 3.0)) + 1
    radii = np.concatenate(([0.0], _FIRST * 3.0 ** np.arange(count)))
    azimuths = np.linspace(0.0, math.tau, _SECTORS + 1)
    vertices = np.zeros((len(radii), len(azimuths)), VERTEX)
    vertices["position"][..., 0] = radii[:, None] * np.cos(azimuths)
    vertices["position"][..., 1] = radii[:, None] * np.sin(azimuths)
    return mesh_node("ground", vertices.reshape(-1), strip_triangles(*vertices.shape))
