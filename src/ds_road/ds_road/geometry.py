# SPDX-License-Identifier: Apache-2.0
"""Geometry of a road: its spline (paper 3.1.1), features of its lines (3.3), and whether it can be driven (3.1.3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

SAMPLES_PER_SEGMENT = 20
"""Samples between two control points, both ends included (maxitwo)."""
ALPHA = 0.5
"""Exponent of the knot spacing; 0.5 makes the spline centripetal (maxitwo)."""


def catmull_rom(control_points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample the spline through all but the first and the last of (n, 2) points, n >= 4, no two neighbours equal.

    There are (20 + 19 (n - 4), 2) samples; one that is shared by two segments appears once.
    """
    segments = [_segment(control_points[i : i + 4]) for i in range(len(control_points) - 3)]
    return np.vstack([segments[0], *(segment[1:] for segment in segments[1:])])


def _segment(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Segment between the second and the third of four points, by the Barry-Goldman pyramid."""
    knots = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T) ** ALPHA)))
    t = np.linspace(knots[1], knots[2], SAMPLES_PER_SEGMENT)[:, None]
    a = [_interpolate(knots[i], knots[i + 1], p[i], p[i + 1], t) for i in range(3)]
    b = [_interpolate(knots[i], knots[i + 2], a[i], a[i + 1], t) for i in range(2)]
    return _interpolate(knots[1], knots[2], b[0], b[1], t)


def _interpolate(
    start: float, end: float, first: NDArray[np.float64], second: NDArray[np.float64], t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate linearly from `first` at `start` to `second` at `end`."""
    return (end - t) / (end - start) * first + (t - start) / (end - start) * second


STRAIGHT = 0.005
"""Largest heading change between two samples that counts as straight, rad (maxitwo)."""
SHORT_STRAIGHT, SHORT_RUN = 10, 15
"""Minimum number of samples of a straight, and of any run; shorter ones are merged into the run before (maxitwo)."""
WINDOW = 5
"""Samples per curvature window; the circle goes through the first, middle and last one (maxitwo)."""
LANE_WINDOW = 4.0
"""Length of lane over which its curvature is averaged, m; chosen: a car's length, which one cannot steer within."""
DIRECTION_BINS = 25
"""Number of equal bins into which directions are sorted over a full circle (DeepHyperion)."""
LARGEST_RADIUS = 90.0
"""Upper limit of the minimum radius, m; a road with this radius counts as straight (DeepHyperion)."""


def curvature(points: NDArray[np.float64]) -> float:
    """Largest curvature of the circles through samples i, i + 2 and i + 4 of a line, (n, 2) m, 1/m; 0 if straight.

    Menger curvature: four times the area of the triangle over the product of its sides. As in maxitwo, the last window
    is left out and an area below 5e-7 m^2 counts as straight.
    """
    windows = len(points) - WINDOW
    if windows < 1:
        return 0.0
    first, middle, last = (points[k : k + windows] for k in (0, 2, 4))
    a, b, c = middle - first, last - middle, first - last
    double_area = np.abs(a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1])
    bent = double_area >= 1e-6
    sides = np.hypot(*a.T) * np.hypot(*b.T) * np.hypot(*c.T)
    return float(np.max(2.0 * double_area[bent] / sides[bent], initial=0.0))


def arc_lengths(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances along a line of (n, 2) points from its first point to each of them, (n,), in the line's unit."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))


def apart(line: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Points of a line without those that are not farther than `spacing`, m, from the one before, as at joints."""
    kept = [line[0]]
    for point in line[1:]:
        if np.hypot(*(point - kept[-1])) > spacing:
            kept.append(point)
    return np.array(kept)


def lane_curvature(lane_centre: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed curvature of a lane, averaged over a window of `LANE_WINDOW` around each place, (k,), 1/m, right positive.

    The lane is (n, 2) samples of its centre line in driving order, the places are (k,) arc lengths along it, m. The
    average is the change of heading between the ends of the window over its length. Headings are those of the steps
    between samples, at the middles of the steps, and linear between them; beyond both ends the lane goes on straight.
    """
    middles, headings = _headings(lane_centre)
    before, after = (np.interp(places + half, middles, headings) for half in (-LANE_WINDOW / 2, LANE_WINDOW / 2))
    return np.asarray((before - after) / LANE_WINDOW, np.float64)


def largest_lane_curvature(lane_centre: NDArray[np.float64], side: Literal["right", "left"]) -> float:
    """Largest curvature of a lane to one side, 1/m; 0 if it never bends to that side. See `lane_curvature`.

    The average is piecewise linear in the place of the window, so it is largest where an end of the window lies in the
    middle of a step.
    """
    middles, _ = _headings(lane_centre)
    places = np.concatenate((middles - LANE_WINDOW / 2, middles + LANE_WINDOW / 2))
    sign = 1.0 if side == "right" else -1.0
    return float(np.max(sign * lane_curvature(lane_centre, places), initial=0.0))


def _headings(line: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Arc length of the middle of each step of a line, m, and the step's heading, rad, without jumps."""
    steps = np.diff(line, axis=0)
    lengths = np.hypot(*steps.T)
    return np.cumsum(lengths) - lengths / 2, np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))


def turns_count(points: NDArray[np.float64], *, maxitwo_compatible: bool = False) -> int:
    """Number of turns of a road, from (n, 2) samples of its centre line.

    Heading changes are wrapped to [-pi, pi), or as maxitwo does it, which applies degree constants to radians: a jump
    by a full turn is not removed and counts as a bend.
    """
    steps = np.diff(points, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    change = np.concatenate(([0.0], np.diff(heading)))
    half_turn = 180.0 if maxitwo_compatible else math.pi
    change = (change + half_turn) % (2 * half_turn) - half_turn
    labels = ["s" if abs(d) <= STRAIGHT else "l" if d > 0 else "r" for d in change]
    runs = [(label, len(list(group))) for label, group in groupby(labels)]
    # Short straights, and short turns after a turn to the same side; then all short runs.
    runs = _absorb(
        runs, lambda run, length, last: length < SHORT_STRAIGHT if run == "s" else length < SHORT_RUN and run == last
    )
    runs = _absorb(runs, lambda run, length, last: length < SHORT_RUN)
    return sum(label != "s" for label, _ in runs)


def minimum_radius(points: NDArray[np.float64]) -> float:
    """Radius of the tightest bend, m: the inverse of `curvature`, at most `LARGEST_RADIUS` (DeepHyperion)."""
    largest = curvature(points)
    return min(1.0 / largest, LARGEST_RADIUS) if largest else LARGEST_RADIUS


def direction_coverage(points: NDArray[np.float64]) -> float:
    """Share of all directions that the road takes, in [0, 1].

    As in DeepHyperion: the angle between each step and north, 0 to 180 degrees whether to the left or to the right, is
    sorted into bins of 360 / 25 degrees; the result is the number of bins hit over 26, the number of bin edges. A road
    can therefore cover about half of the bins at most.
    """
    steps = np.diff(points, axis=0)
    angles = np.degrees(np.arccos(np.clip(steps[:, 1] / np.hypot(*steps.T), -1.0, 1.0)))
    edges = np.linspace(0.0, 360.0, DIRECTION_BINS + 1)
    return len(np.unique(np.digitize(angles, edges))) / len(edges)


def _absorb(runs: list[tuple[str, int]], joins: Callable[[str, int, str], bool]) -> list[tuple[str, int]]:
    """Merge runs that are too short into the run before them."""
    kept: list[tuple[str, int]] = []
    for label, length in runs:
        if kept and joins(label, length, kept[-1][0]):
            kept[-1] = (kept[-1][0], kept[-1][1] + length)
        else:
            kept.append((label, length))
    return kept


BOX = 250.0
"""Side of the square that contains every road, from (0, 0) to (250, 250), m (paper 3.1.3)."""
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Validity:
    """Whether a road is valid, and if not, a short reason."""

    valid: bool
    reason: str = ""


def check_surface(left: NDArray[np.float64], right: NDArray[np.float64], *, box: float | None = BOX) -> Validity:
    """Check the surface between a road's two edges, (n, 2) m each, and that both are in the box, if there is one.

    The surface is a strip of quadrilaterals, one per pair of samples. maxitwo requires that each is a valid polygon,
    that neighbours share their common side and nothing else, and that no other two touch. The last condition is costly
    to check but follows from the outline: a strip without folds overlaps nowhere if its outline does not intersect
    itself.
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
