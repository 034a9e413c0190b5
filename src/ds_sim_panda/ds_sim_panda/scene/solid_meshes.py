"""Puts the shapes where the scenery wants them, lit by sun and sky, in meshes of neighbouring things."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_sim_panda.scene.graphics import panda
from ds_sim_panda.scene.meshes import VERTEX, mesh_node
from ds_sim_panda.scene.scenery import Things
from ds_sim_panda.scene.shaders import MOST_LIGHT
from ds_sim_panda.scene.solids import Solid, solid
from ds_sim_panda.scene.sunlight import Daylight

CELL = 60.0
"""Things in one square of this side are one mesh, which is left out when it is out of view, m; chosen."""


def solid_meshes(scenery: Mapping[str, Things], daylight: Daylight) -> Any:
    """Panda3D's node of everything that stands beside a road."""
    placed = {kind: _vertices(solid(kind), things, daylight) for kind, things in scenery.items()}
    cells = {kind: np.floor(things.position / CELL).astype(int) for kind, things in scenery.items()}
    parent = panda().PandaNode("solids")
    for cell in sorted({tuple(c) for of_kind in cells.values() for c in of_kind.tolist()}):
        vertices, triangles, count = [], [], 0
        for kind, of_kind in cells.items():
            for i in np.flatnonzero((of_kind == cell).all(axis=1)).tolist():
                vertices.append(placed[kind][i])
                triangles.append(solid(kind).triangles + count)
                count += len(placed[kind][i])
        parent.add_child(mesh_node(f"cell {cell}", np.concatenate(vertices), np.concatenate(triangles)))
    return parent


def _vertices(shape: Solid, things: Things, daylight: Daylight) -> NDArray[np.void]:
    """Vertices of a shape at each of some places, (things, vertices) of `VERTEX`."""
    c, s = np.cos(things.yaw)[:, None], np.sin(things.yaw)[:, None]

    def turned(v: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack((c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]), axis=-1)

    vertices = np.zeros((len(things.position), len(shape.position)), VERTEX)
    position = turned(shape.position * things.size[:, None])
    position[..., :2] += things.position[:, None]
    normal = turned(shape.normal / things.size[:, None])
    normal /= np.linalg.norm(normal, axis=-1)[..., None]
    light = daylight.on(normal, softness=shape.softness) * shape.reflectance * things.tint[:, None, None]
    vertices["position"] = position
    vertices["texture"] = shape.texture
    vertices["colour"][..., :3] = np.round(255.0 * np.sqrt(np.clip(light / MOST_LIGHT, 0.0, 1.0)))
    vertices["colour"][..., 3] = 255
    return vertices
