# SPDX-License-Identifier: Apache-2.0
"""Generates and mutates random roads (paper 3.3; maxitwo, corrected where its code differs from its intent)."""

from __future__ import annotations

import math

import numpy as np

from ds_road.geometry import BOX, check_surface, fits
from ds_road.road import LANE_WIDTH, Road, RoadError, Side

SEGMENT_LENGTH = 25.0
"""Distance between two control points, m (maxitwo)."""
NODES = 8
"""Number of control points after the first one (maxitwo)."""
SMALLEST_BOX = 100.0
"""Smallest side of the box, m; chosen: roads with bends of 100 degrees are still found at once; straighter ones need
more."""
MAX_ATTEMPTS = 20
"""Headings tried before a road is started over (maxitwo)."""
MAX_RESTARTS = 2000
"""Roads started before giving up; chosen: about one in three succeeds at a maximum angle of 270 degrees."""
GENES = (4, 5, 6)
"""Indices of the control points that mutation may move (maxitwo)."""
TRIES_PER_GENE = 11
"""Moves tried on a control point before switching to another one (maxitwo)."""


class MutationError(RoadError):
    """No valid mutant of a road was found."""


def generate(rng: np.random.Generator, *, max_angle: int = 270, box: float = BOX, lane: Side = "right") -> Road:
    """Generate a random valid road of nine control points, 25 m apart, that starts at (box / 2, 25) and heads north.

    Args:
        rng: source of all random numbers.
        max_angle: largest heading change from one segment to the next, degrees, 1 to 360.
        box: side of the square with one corner at the origin that contains the road, m, 100 to 250.
        lane: lane that is driven; it does not affect the control points.

    Raises:
        RoadError: angle or box is out of range, or no valid road was found.

    Examples:
        >>> import numpy as np
        >>> from ds_road import generate
        >>> rng = np.random.default_rng(7)
        >>> road = generate(rng, max_angle=200)
        >>> len(road.control_points), road.validity.valid
        (9, True)
    """
    if not 1 <= max_angle <= 360:
        raise RoadError(f"maximum angle is {max_angle}, expected 1 to 360 degrees")
    if not SMALLEST_BOX <= box <= BOX:
        raise RoadError(f"box is {box:g} m, expected {SMALLEST_BOX:g} to {BOX:g}")
    for _ in range(MAX_RESTARTS):
        nodes = _random_nodes(rng, max_angle, box)
        if nodes is not None:
            road = Road(nodes[1:], lane=lane)
            if fits(road.left_edge, road.right_edge, box) and road.validity.valid:
                return road
    raise RoadError(f"no valid road found in {MAX_RESTARTS} attempts: choose another maximum angle or a larger box")


def mutate(road: Road, rng: np.random.Generator, *, extent: int = 6, maxitwo_compatible: bool = False) -> Road:
    """Create a valid road that differs in one coordinate of one of the control points 4, 5 and 6.

    Args:
        road: parent with at least seven control points; it is not changed.
        rng: source of all random numbers.
        extent: largest move, m, at least 1; moves are whole metres.
        maxitwo_compatible: let the mutant's spline ignore its first control point, as in maxitwo; by default it uses
            all of them, even if `road` is maxitwo-compatible.

    Raises:
        RoadError: the extent is out of range.
        MutationError: no valid mutant was found.

    Examples:
        >>> import numpy as np
        >>> from ds_road import generate, mutate
        >>> rng = np.random.default_rng(7)
        >>> road = generate(rng)
        >>> changed = mutate(road, rng)
        >>> sum(old != new for old, new in zip(road.control_points, changed.control_points))
        1
    """
    if extent < 1:
        raise RoadError(f"mutation extent is {extent}, expected at least 1 m")
    if road.sampled:
        raise MutationError(f"road {road.road_id} is given by road points, expected control points to move")
    genes = [gene for gene in GENES if gene < len(road.control_points)]
    for gene in rng.permutation(genes)[: len(genes) - 1]:
        for _ in range(TRIES_PER_GENE):
            axis = int(rng.integers(2))
            delta = int(rng.integers(-extent, extent + 1)) or 1
            points = [list(point) for point in road.control_points]
            points[gene][axis] += delta
            try:
                mutant = Road(points, lane_width=road.lane_width, maxitwo_compatible=maxitwo_compatible, lane=road.lane)
            except RoadError:
                continue
            if mutant.validity.valid:
                return mutant
    raise MutationError(f"no valid mutant of road {road.road_id} found: choose another road or a smaller extent")


def _random_nodes(rng: np.random.Generator, max_angle: int, box: float) -> list[tuple[float, float]] | None:
    """Nodes of a road whose straight segments are valid, or None if the attempts are used up."""
    nodes = [(box / 2, -SEGMENT_LENGTH), (box / 2, 0.0)]  # the first is behind the first control point (maxitwo)
    attempt = 0
    while len(nodes) - 2 < NODES and attempt <= MAX_ATTEMPTS:
        accepted = len(nodes) - 2
        for proposal in range(1 + NODES - accepted):
            attempt += proposal > 0
            nodes.append(_next_node(rng, nodes, max_angle if accepted not in (0, 1, NODES - 1) else 0))
            if _segments_are_valid(nodes, box, first=accepted == 0):
                break
            nodes.pop()
        else:
            attempt += 1
            if len(nodes) > 2:
                nodes.pop()
    return nodes if len(nodes) - 2 == NODES else None


def _next_node(rng: np.random.Generator, nodes: list[tuple[float, float]], angle: int) -> tuple[float, float]:
    """Next node, one segment on, turned by up to `angle` degrees; unlike in maxitwo, the heading is not truncated."""
    (x0, y0), (x1, y1) = nodes[-2:]
    heading = math.atan2(y1 - y0, x1 - x0) + math.radians(int(rng.integers(-angle, angle + 1)))
    return x1 + SEGMENT_LENGTH * math.cos(heading), y1 + SEGMENT_LENGTH * math.sin(heading)


def _segments_are_valid(nodes: list[tuple[float, float]], box: float, *, first: bool) -> bool:
    """True if the straight segments do not touch each other and the newest is in the box (the first one enters it)."""
    points = np.array(nodes)
    steps = np.diff(points, axis=0)
    steps = np.vstack((steps, steps[-1:])) / SEGMENT_LENGTH
    across = LANE_WIDTH * np.stack((steps[:, 1], -steps[:, 0]), axis=1)
    left, right = points - across, points + across
    newest = np.vstack((left[-2:], right[-2:]))
    if not first and (newest.min() < 0.0 or newest.max() > box):
        return False
    return check_surface(left, right, box=None).valid
