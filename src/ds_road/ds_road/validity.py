"""When a road can be driven: it stays in its box and nowhere meets itself (paper 3.1.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

BOX = 250.0
"""Side of the square that holds every road, from (0, 0) to (250, 250), m (paper 3.1.3)."""


@dataclass(frozen=True)
class Validity:
    """Whether a road is valid, and if not, why, in a few words."""

    valid: bool
    reason: str = ""


def check_surface(
    left: NDArray[np.float64], right: NDArray[np.float64], *, inside: tuple[float, float] | None = (0.0, BOX)
) -> Validity:
    """Check the surface between a road's two edges.

    The surface is a strip of quadrilaterals, one per pair of samples. Each must be a proper polygon, neighbours must
    meet in their common side alone, and the others not at all (maxitwo's rule, with an index instead of all pairs).

    Args:
        left: (n, 2) points of the left edge, m.
        right: (n, 2) points of the right edge, m.
        inside: lowest and highest coordinate allowed, None to skip.
    """
    if inside is not None:
        edges = np.vstack((left, right))
        if edges.min() < inside[0] or edges.max() > inside[1]:
            return Validity(False, f"it leaves the box of {inside[1]:g} x {inside[1]:g} m")
    if np.array_equal(left[0], left[-1]) and np.array_equal(right[0], right[-1]):
        return Validity(False, "its start is its end")
    quads = shapely.polygons(np.stack((left[:-1], left[1:], right[1:], right[:-1]), axis=1))
    if not shapely.is_valid(quads).all():
        return Validity(False, "a bend is so sharp that the road's edge folds")
    common = shapely.intersection(quads[:-1], quads[1:])
    if not (shapely.get_type_id(common) == shapely.GeometryType.LINESTRING).all():
        return Validity(False, "a bend is so sharp that the road's edge folds")
    first, second = shapely.STRtree(quads).query(quads, predicate="intersects")
    if (np.abs(first - second) > 1).any():
        return Validity(False, "it crosses itself")
    return Validity(True)
