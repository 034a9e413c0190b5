"""Checks whether a road can be driven: it stays inside its box and never touches itself (paper 3.1.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

BOX = 250.0
"""Side of the square that contains every road, from (0, 0) to (250, 250), m (paper 3.1.3)."""
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Validity:
    """Whether a road is valid, and if not, a short reason."""

    valid: bool
    reason: str = ""


def check_surface(left: NDArray[np.float64], right: NDArray[np.float64], *, box: float | None = BOX) -> Validity:
    """Check the surface between a road's two edges.

    The surface is a strip of quadrilaterals, one per pair of samples. maxitwo requires that each is a valid polygon,
    that neighbours share their common side and nothing else, and that no other two touch. The last condition is costly
    to check but follows from the outline: a strip without folds overlaps nowhere if its outline does not intersect
    itself.

    Args:
        left: (n, 2) points of the left edge, m.
        right: (n, 2) points of the right edge, m.
        box: side of the square with one corner at the origin that must contain both edges, m; None for no limit.
    """
    if box is not None and not fits(left, right, box):
        return Validity(False, f"it leaves the box of {box:g} x {box:g} m")
    if np.abs((left[0] + right[0]) - (left[-1] + right[-1])).max() < 2 * _TOLERANCE:
        return Validity(False, "its start is its end")
    quads = shapely.polygons(np.stack((left[:-1], left[1:], right[1:], right[:-1]), axis=1))
    if not shapely.is_valid(quads).all() or not _share_only_sides(left, right, quads):
        return Validity(False, "a bend is so sharp that the road's edge folds")
    if not shapely.is_valid(shapely.Polygon(np.vstack((left, right[::-1])))):
        return Validity(False, "it crosses itself")
    return Validity(True)


def fits(left: NDArray[np.float64], right: NDArray[np.float64], box: float) -> bool:
    """True if both edges stay in the square from (0, 0) to (box, box), m."""
    return bool(min(left.min(), right.min()) >= 0.0 and max(left.max(), right.max()) <= box)


def _share_only_sides(left: NDArray[np.float64], right: NDArray[np.float64], quads: NDArray[np.object_]) -> bool:
    """True if neighbouring quadrilaterals share their common side and nothing else.

    They do if they lie on either side of the line through that side; the few others are intersected.
    """
    side = right[1:-1] - left[1:-1]

    def ahead(points: NDArray[np.float64]) -> NDArray[np.float64]:
        offset: NDArray[np.float64] = points - left[1:-1]
        return offset[:, 0] * -side[:, 1] + offset[:, 1] * side[:, 0]

    apart = np.maximum(ahead(left[:-2]), ahead(right[:-2])) < 0.0
    apart &= np.minimum(ahead(left[2:]), ahead(right[2:])) > 0.0
    common = shapely.intersection(quads[:-1][~apart], quads[1:][~apart])
    return bool((shapely.get_type_id(common) == shapely.GeometryType.LINESTRING).all())
