# SPDX-License-Identifier: Apache-2.0
"""Shapes of what stands beside the road, and their meshes where the scenery wants them, lit by sun and sky."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ds_sim_panda.scene.graphics import panda
from ds_sim_panda.scene.meshes import VERTEX, mesh_node
from ds_sim_panda.scene.parameters import BARK, LEAVES, NEEDLES, POST, ROOF, WALL, Linear
from ds_sim_panda.scene.scenery import Things
from ds_sim_panda.scene.setting import Daylight
from ds_sim_panda.scene.shaders import MOST_LIGHT
from ds_sim_panda.scene.textures import LAYERS

DIAGONAL = math.sqrt(2.0)
"""Plants are round: their radius is the diagonal of their half length and width."""


@dataclass(frozen=True)
class Solid:
    """A shape."""

    position: NDArray[np.float64]  # (n, 3)
    normal: NDArray[np.float64]  # unit vectors, (n, 3)
    texture: NDArray[np.float64]  # coordinates and layer, (n, 3)
    reflectance: NDArray[np.float64]  # (n, 3) linear RGB
    softness: NDArray[np.float64]  # how far sunlight reaches round it, (n,); see `Daylight.on`
    triangles: NDArray[np.int64]  # (m, 3)


@cache
def solid(kind: str) -> Solid:
    """Shape of a kind of thing; see `scenery.place_scenery`."""
    shapes = {
        "broadleaf": lambda: _broadleaf(lumps=4, points=18, sides=5),
        "far broadleaf": lambda: _broadleaf(lumps=3, points=10, sides=3),
        "conifer": lambda: _conifer(sides=8),
        "far conifer": lambda: _conifer(sides=5),
        "bush": lambda: _bush(points=16),
        "far bush": lambda: _bush(points=9),
        "house": _house,
        "post": _post,
    }
    return shapes[kind]()


def _joined(parts: Iterable[Solid]) -> Solid:
    moved: list[Solid] = []
    for part in parts:
        first = sum(len(one.position) for one in moved)
        moved.append(replace(part, triangles=part.triangles + first))
    return Solid(*(np.concatenate([getattr(part, field.name) for part in moved]) for field in fields(Solid)))


def _blob(
    centre: tuple[float, float, float], radii: tuple[float, float], colour: Linear, layer: str, seed: int, points: int
) -> Solid:
    """Rough ellipsoid with horizontal and vertical radii, darker below, where leaves shade leaves."""
    index = np.arange(points) + 0.5
    z = 1.0 - 2.0 * index / points
    angle = index * math.pi * (3.0 - math.sqrt(5.0))
    sphere = np.stack((np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z), axis=1)
    triangles = ConvexHull(sphere).simplices.astype(np.int64)
    corners = sphere[triangles]
    inward = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners[:, 0]).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    rough = np.random.default_rng(seed).uniform(0.86, 1.0, points)[:, None]
    scale = np.array((radii[0], radii[0], radii[1]))
    normal = sphere / scale
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    # Projected along a slanted axis, so that no side shows it stretched to lines.
    u, v = 1.5 * sphere[:, 0] + 0.9 * sphere[:, 1], 1.5 * sphere[:, 2] + 0.9 * sphere[:, 1]
    texture = np.stack((u, v, np.full(points, LAYERS.index(layer))), axis=1)
    shade = 0.55 + 0.45 * (0.5 + 0.5 * z)
    return Solid(
        sphere * rough * scale + centre,
        normal,
        texture,
        shade[:, None] * colour,
        np.full(points, 0.35),
        triangles,
    )


def _cone(
    low: float, high: float, radii: tuple[float, float], colour: Linear, layer: str, *, sides: int, softness: float
) -> Solid:
    """Cone or frustum about the vertical, open at its ends."""
    angle = np.linspace(0.0, math.tau, sides + 1)
    around = np.stack((np.cos(angle), np.sin(angle), np.zeros(sides + 1)), axis=1)
    rings = [around * r + (0.0, 0.0, z) for r, z in ((radii[0], low), (radii[1], high))]
    normal = around + (0.0, 0.0, (radii[0] - radii[1]) / (high - low))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    index = np.arange(sides)
    a, b, c, d = index, index + 1, index + sides + 1, index + sides + 2
    triangles = [np.stack((a, b, d), 1), *([np.stack((a, d, c), 1)] if radii[1] else [])]
    texture = np.zeros((2 * sides + 2, 3))
    texture[:, 0] = np.tile(np.linspace(0.0, 2.0, sides + 1), 2)
    texture[sides + 1 :, 1] = 1.0
    texture[:, 2] = LAYERS.index(layer)
    shade = np.repeat((0.65, 1.0), sides + 1)[:, None]
    return Solid(
        np.concatenate(rings),
        np.tile(normal, (2, 1)),
        texture,
        shade * colour,
        np.full(2 * sides + 2, softness),
        np.concatenate(triangles),
    )


def _quad(corners: list[tuple[float, float, float]], colour: Linear, layer: str, tiles: tuple[float, float]) -> Solid:
    """Flat face with three or four corners, counter-clockwise from outside; `tiles`: repetitions of its texture."""
    position = np.array(corners)
    normal = np.cross(position[1] - position[0], position[2] - position[0])
    normal /= np.sqrt((normal**2).sum())
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)[: len(corners)] * tiles
    texture = np.column_stack((square, np.full(len(corners), LAYERS.index(layer))))
    triangles = np.array([(0, 1, 2), (0, 2, 3)][: len(corners) - 2])
    tiled = np.tile(colour, (len(corners), 1))
    return Solid(position, np.tile(normal, (len(corners), 1)), texture, tiled, np.zeros(len(corners)), triangles)


def _box(
    half: tuple[float, float], low: float, high: float, colour: Linear, layer: str, tiles: tuple[float, float, float]
) -> Solid:
    """Upright box without a bottom; `tiles`: repetitions of the texture along x, y and z."""
    x, y = half
    ring = [(-x, -y), (x, -y), (x, y), (-x, y)]
    sides = [
        _quad([(*a, low), (*b, low), (*b, high), (*a, high)], colour, layer, (tiles[i % 2], tiles[2]))
        for i, (a, b) in enumerate(zip(ring, [*ring[1:], ring[0]], strict=True))
    ]
    return _joined([*sides, _quad([(*p, high) for p in ring], colour, "plain", (1, 1))])


def _broadleaf(*, lumps: int, points: int, sides: int) -> Solid:
    """Trunk and a crown of rough lumps."""
    d = DIAGONAL
    crown = (
        ((0.0, 0.0, 0.67), (0.76, 0.33)),
        ((0.42, 0.12, 0.50), (0.56, 0.23)),
        ((-0.30, 0.34, 0.54), (0.56, 0.25)),
        ((-0.16, -0.42, 0.48), (0.54, 0.22)),
    )
    blobs = [
        _blob((x * d, y * d, z), (r * d, h), LEAVES, "leaves", seed, points)
        for seed, ((x, y, z), (r, h)) in enumerate(crown[:lumps])
    ]
    return _joined((_cone(0.0, 0.5, (0.11 * d, 0.07 * d), BARK, "bark", sides=sides, softness=0.0), *blobs))


def _conifer(*, sides: int) -> Solid:
    """Trunk and three cones."""
    d = DIAGONAL
    cones = [
        _cone(low, high, (r * d, 0.0), NEEDLES, "needles", sides=sides, softness=0.3)
        for low, high, r in ((0.12, 0.58, 1.0), (0.34, 0.80, 0.76), (0.58, 1.0, 0.50))
    ]
    return _joined((_cone(0.0, 0.2, (0.13 * d, 0.11 * d), BARK, "bark", sides=3, softness=0.0), *cones))


def _bush(*, points: int) -> Solid:
    d = DIAGONAL
    lumps = (((0.0, 0.0, 0.45), (0.8 * d, 0.55)), ((0.4 * d, 0.2 * d, 0.3), (0.5 * d, 0.4)))
    return _joined(_blob(*lump, LEAVES, "leaves", 10 + i, points) for i, lump in enumerate(lumps))


def _house() -> Solid:
    """Two storeys, gabled roof with eaves, chimney."""
    x, y, eaves = 0.92, 0.88, 0.66
    walls = _box((x, y), 0.0, eaves, WALL, "wall", (3.0, 2.0, 2.0))
    gables = [
        _quad([(s * x, -s * y, eaves), (s * x, s * y, eaves), (s * x, 0.0, 0.97)], WALL, "plain", (1, 1))
        for s in (-1.0, 1.0)
    ]
    low, ridge = 0.62, 1.0
    roof = [
        _quad([(-s, -s, low), (s, -s, low), (s, 0.0, ridge), (-s, 0.0, ridge)], ROOF, "roof", (4.0, 2.0))
        for s in (1.0, -1.0)
    ]
    below = [
        _quad([(s, -s, low), (-s, -s, low), (-s, 0.0, ridge), (s, 0.0, ridge)], (0.1, 0.08, 0.06), "plain", (1, 1))
        for s in (1.0, -1.0)
    ]
    chimney = _box((0.06, 0.09), 0.8, 1.08, ROOF, "plain", (1, 1, 1))
    chimney.position[:, :2] += (0.4, 0.25)
    return _joined((walls, *gables, *roof, *below, chimney))


def _post() -> Solid:
    """White post with the black band of a delineator."""
    bands = ((0.0, 0.70, POST), (0.70, 0.90, (0.03, 0.03, 0.03)), (0.90, 1.0, POST))
    return _joined(_box((1.0, 1.0), low, high, colour, "plain", (1, 1, 1)) for low, high, colour in bands)


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
