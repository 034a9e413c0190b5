# SPDX-License-Identifier: Apache-2.0
"""Level of one factor at which a driver first fails: on each road, by bisection, and for the median road."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import shapely

from ds_analysis.sensitivity import LEVELS, Factor, RoadResult
from ds_road import Road, generate
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.oracle import FINISH_MARGIN
from ds_sim.scenario import Scenario


def first_failure(fails: Callable[[int], bool], highest: int, near: RoadResult | None = None) -> RoadResult:
    """Bisect integer levels from 0, which is taken to be completed, to the highest one, which may be 0.

    The level found fails, and the one below is completed; it is the lowest such one where failing is monotone. `near`
    is the result for a similar road, around which is searched: two drives if it holds here, too.
    """
    if highest == 0:
        return RoadResult(completes=0)
    low, high = 0, highest + 1

    def drive(level: int) -> None:
        nonlocal low, high
        if low < level < high:
            low, high = (low, level) if fails(level) else (level, high)

    if near is None or near.fails is None:
        drive(highest)
    else:  # search from there in steps that double, as roads differ by little
        drive(near.fails)
        drive(near.fails - 1)
        step = 1
        while high < near.fails and low == 0 and high > 1:
            drive(max(high - step, 1))
            step *= 2
        while low >= near.fails and high > highest and low < highest:
            drive(min(low + step, highest))
            step *= 2
    while high - low > 1:
        drive((low + high) // 2)
    return RoadResult(completes=low, fails=high if high <= highest else None)


SEGMENTS = 4
"""Segments of a road, 25 m each, of the six of a generated one: a straight one and three bends. Chosen: saves a third
of the time, and a driver that cannot see fails in its first bends; one that swings up may need more."""
MOST_SEGMENTS = 6
"""Segments of a generated road: the spline goes from its second control point to the last but one."""
MAX_ANGLE = 270
"""Largest angle of the roads before they are cut, degrees: that of the training roads (paper 4.2.2)."""
CANDIDATES = 3
"""Roads tried for each one needed; chosen: a driver that completes fewer needs no conditions to fail."""

TESTED, GATE = "tested", "gate"
Fails = Callable[[str, int, Conditions], bool]
"""Whether the driver (`TESTED`) fails on the road of a number under conditions; `GATE`: whether no driver can be judged
there, as the autopilot fails or the lines are invisible (`ds_sim.gates`)."""


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
    straight = lane[0] + np.outer(np.arange(0.0, length - FINISH_MARGIN, 1.0), ahead)
    apart = shapely.distance(shapely.points(straight), shapely.LineString(lane))
    return bool(np.max(apart) > road.lane_width / 2)


def choose_roads(count: int, needed: int, fails: Fails) -> tuple[int, ...]:
    """Numbers of the first roads that the driver completes under default conditions, and that the gates let pass."""
    chosen: list[int] = []
    for road in range(count):
        if len(chosen) < needed and not fails(GATE, road, DEFAULT) and not fails(TESTED, road, DEFAULT):
            chosen.append(road)
    return tuple(chosen)


def measure(factor: Factor, roads: int, fails: Fails, *, levels: int = LEVELS) -> tuple[RoadResult, ...]:
    """Bisect a factor on each road, the strongest value first; returns the results of the roads that were driven.

    The gates judge the level at which the driver begins to fail. As soon as it completes the strongest value on so many
    roads that the median cannot fail, no more are driven. `levels`, how many may be driven, is one of `RESOLUTIONS`.
    """
    step = LEVELS // levels
    results: list[RoadResult] = []
    near: RoadResult | None = None
    for road in range(roads):
        if sum(one.withstands_all for one in results) > roads // 2:
            break
        near = first_failure(
            lambda level, road=road: fails(TESTED, road, factor.conditions(level * step)),  # type: ignore[misc]
            levels,
            near,
        )
        one = RoadResult(completes=near.completes * step, fails=near.fails and near.fails * step)
        if one.fails is not None and fails(GATE, road, factor.conditions(one.fails)):
            one = replace(one, fails=None, excluded=one.fails)
        results.append(one)
    return tuple(results)
