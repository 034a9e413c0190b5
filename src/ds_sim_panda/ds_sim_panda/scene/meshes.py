# SPDX-License-Identifier: Apache-2.0
"""Triangles as NumPy arrays, and their way into Panda3D: the strip of a road, the rings of the ground around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_road.geometry import arc_lengths
from ds_sim.camera.ground import with_leads
from ds_sim_panda.scene.graphics import panda
from ds_sim_panda.scene.parameters import GROUND_RADIUS, LEAD_IN, LEAD_OUT

VERTEX = np.dtype([("position", "<f4", 3), ("texture", "<f4", 3), ("colour", "u1", 4)])
"""A vertex: position, m; texture coordinates, whose third is a layer or free; colour."""


def mesh_node(name: str, vertices: NDArray[np.void], triangles: NDArray[np.integer[Any]]) -> Any:
    """Panda3D's node of `VERTEX` and triangles (m, 3), counter-clockwise from outside and drawn in this order."""
    core = panda()
    data = core.GeomVertexData(name, _vertex_format(), core.Geom.UH_static)
    data.unclean_set_num_rows(len(vertices))
    data.modify_array_handle(0).copy_data_from(vertices.tobytes())
    primitive = core.GeomTriangles(core.Geom.UH_static)
    primitive.set_index_type(core.Geom.NT_uint32)
    indices = primitive.modify_vertices()
    indices.unclean_set_num_rows(triangles.size)
    indices.modify_handle().copy_data_from(triangles.astype("<u4").tobytes())
    geom = core.Geom(data)
    geom.add_primitive(primitive)
    node = core.GeomNode(name)
    node.add_geom(geom)
    return node


@cache
def _vertex_format() -> Any:
    core = panda()
    columns = core.GeomVertexArrayFormat()
    columns.add_column(core.InternalName.get_vertex(), 3, core.Geom.NT_float32, core.Geom.C_point)
    columns.add_column(core.InternalName.get_texcoord(), 3, core.Geom.NT_float32, core.Geom.C_texcoord)
    columns.add_column(core.InternalName.get_color(), 4, core.Geom.NT_uint8, core.Geom.C_color)
    return core.GeomVertexFormat.register_format(core.GeomVertexFormat(columns))


def strip_triangles(rows: int, columns: int) -> NDArray[np.int64]:
    """Triangles of a grid of vertices, row by row, (m, 3)."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    return np.stack((a, b, d, a, d, c), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Course:
    """Centre line of a road with a straight lead at either end, relative to `origin`."""

    origin: NDArray[np.float64]  # corner of the road's bounding box in the road frame, (2,), m
    points: NDArray[np.float64]  # (n, 2), m
    right: NDArray[np.float64]  # unit vectors to the right of each point, (n, 2)
    along: NDArray[np.float64]  # distance along the line from the road's first point, (n,), m
    half_width: float  # distance of either border, m
    two_lanes: bool  # whether there is a centre line


def course_of(road: Road) -> Course:
    """Centre line of a road with its leads; the road's own samples are kept exactly."""
    points, right = with_leads(road, LEAD_IN, LEAD_OUT)
    origin = np.floor(road.points.min(axis=0))
    return Course(
        origin=origin,
        points=points - origin,
        right=right,
        along=arc_lengths(points) - LEAD_IN,
        half_width=road.half_width,
        two_lanes=road.has_centre_line,
    )


def road_strip(course: Course, offsets: Sequence[float]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """Vertices and triangles of the road, leads first, so that the road lies over them.

    There is a line of vertices at each of the offsets, m, from left to right of the centre line. Texture coordinates
    are the distance to the right of that line and along it, m.
    """
    across = np.asarray(offsets)
    rows = len(course.points)
    vertices = np.zeros((rows, len(across)), VERTEX)
    vertices["position"][..., :2] = course.points[:, None] + across[:, None] * course.right[:, None]
    vertices["texture"][..., 0] = across
    vertices["texture"][..., 1] = course.along[:, None]
    triangles = strip_triangles(rows, len(across)).reshape(rows - 1, -1, 3)
    in_order = np.concatenate((triangles[:1], triangles[-1:], triangles[1:-1]))
    return vertices.reshape(-1), in_order.reshape(-1, 3)


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
