"""Triangles as NumPy arrays, and their way into Panda3D."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_sim_panda.scene.graphics import panda

VERTEX = np.dtype([("position", "<f4", 3), ("texture", "<f4", 3), ("colour", "u1", 4)])
"""A vertex: position, m; texture coordinates, whose third is a layer or free; colour."""


def mesh_node(name: str, vertices: NDArray[np.void], triangles: NDArray[np.integer[Any]]) -> Any:
    """Panda3D's node of a mesh.

    Args:
        name: of the node.
        vertices: (n,) of `VERTEX`.
        triangles: (m, 3) indices, counter-clockwise seen from outside; they are drawn in this order.
    """
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
