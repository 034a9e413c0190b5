"""Road as a strip of triangles whose vertices know how far they are across and along it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim_panda.scene.meshes import VERTEX, strip_triangles
from ds_sim_panda.scene.parameters import LEAD_IN, LEAD_OUT


@dataclass(frozen=True)
class Course:
    """Centre line of a road with a straight lead at either end, relative to `origin`.

    Attributes:
        origin: corner of the road's bounding box in the road frame, (2,), m.
        points: (n, 2), m.
        right: unit vectors to the right of each point, (n, 2).
        along: distance along the line from the road's first point, (n,), m.
        half_width: distance of either border, m.
    """

    origin: NDArray[np.float64]
    points: NDArray[np.float64]
    right: NDArray[np.float64]
    along: NDArray[np.float64]
    half_width: float


def course_of(road: Road) -> Course:
    """Centre line of a road with its leads; the road's own samples are kept exactly."""
    right = (road.right_edge - road.points) / road.lane_width
    ahead = np.stack((-right[:, 1], right[:, 0]), axis=1)
    origin = np.floor(road.points.min(axis=0))
    points = np.vstack((road.points[0] - LEAD_IN * ahead[0], road.points, road.points[-1] + LEAD_OUT * ahead[-1]))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T)))) - LEAD_IN
    return Course(
        origin=origin,
        points=points - origin,
        right=np.vstack((right[:1], right, right[-1:])),
        along=along,
        half_width=road.lane_width,
    )


def road_strip(course: Course, offsets: Sequence[float]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """Vertices and triangles of the road between two borders, leads first, so that the road lies over them.

    Texture coordinates are the distance to the right of the centre line and that along it, m.

    Args:
        course: the road.
        offsets: distances of the lines of vertices to the right of the centre line, from left to right, m.
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
