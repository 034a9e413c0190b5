# SPDX-License-Identifier: Apache-2.0
"""Draws short roads on which a car must steer; without the libraries of an engine, which load longer than a drive."""

from __future__ import annotations

import numpy as np
import shapely

from ds_road import Road, generate
from ds_sim.oracle import OracleLimits
from ds_sim.scenario import Scenario

SEGMENTS = 4
"""Segments of a road, 25 m each, of the six of a generated one: a straight one and three bends. Chosen: saves a third
of the time, and a driver that cannot see fails in its first bends; one that swings up may need more."""
MOST_SEGMENTS = 6
"""Segments of a generated road: the spline goes from its second control point to the last but one."""
MAX_ANGLE = 270
"""Largest angle of the roads before they are cut, degrees: that of the training roads (paper 4.2.2)."""
CANDIDATES = 3
"""Roads tried for each one needed; chosen: a driver that completes fewer needs no conditions to fail."""


def candidate_roads(count: int, seed: int, *, segments: int = SEGMENTS) -> list[Scenario]:
    """Generate candidates for a number of roads; fewer roads have the same first ones.

    Each is the beginning of a random road, 2 to `MOST_SEGMENTS` segments of 25 m, on which a car must steer. The seed
    is that of the roads, and of the runs on the first one.
    """
    rng = np.random.default_rng(seed)
    candidates: list[Scenario] = []
    while len(candidates) < CANDIDATES * count:
        road = Road(generate(rng, max_angle=MAX_ANGLE).control_points[: segments + 3])
        if road.validity.valid and _needs_steering(road):
            candidates.append(Scenario(road, seed=(seed + len(candidates)) % 2**32))
    return candidates


def _needs_steering(road: Road) -> bool:
    """Whether a straight line from the start of the lane leaves it."""
    lane = road.lane_centre
    length = float(np.hypot(*np.diff(lane, axis=0).T).sum())
    ahead = (lane[1] - lane[0]) / np.hypot(*(lane[1] - lane[0]))
    straight = lane[0] + np.outer(np.arange(0.0, length - OracleLimits().finish_margin, 1.0), ahead)
    apart = shapely.distance(shapely.points(straight), shapely.LineString(lane))
    return bool(np.max(apart) > road.lane_width / 2)
