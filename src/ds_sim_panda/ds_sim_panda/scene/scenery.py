# SPDX-License-Identifier: Apache-2.0
"""Decides what stands where beside a road: trees, bushes, houses and posts, never on the road or its verge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from ds_sim_panda.scene import parameters
from ds_sim_panda.scene.meshes import Course


@dataclass(frozen=True)
class Things:
    """Things of one kind."""

    position: NDArray[np.float64]  # (n, 2), relative to the course's origin, m
    size: NDArray[np.float64]  # half length, half width and height, (n, 3), m
    yaw: NDArray[np.float64]  # (n,), rad
    tint: NDArray[np.float64]  # brightness relative to the material, (n,)

    @property
    def reach(self) -> NDArray[np.float64]:
        """Radius around each position that nothing of it exceeds, (n,), m."""
        return np.hypot(self.size[:, 0], self.size[:, 1])


def place_scenery(course: Course, seed: int) -> dict[str, Things]:
    """Place everything beside a road: kind -> things."""
    rng = np.random.default_rng(seed)
    line = shapely.LineString(course.points)
    border = course.half_width + parameters.VERGE_WIDTH
    houses = _houses(course, line, border, rng)
    plants = _plants(course, line, border, houses, rng)
    return {"house": houses, "post": _posts(course, line, border), **plants}


def _distance(line: shapely.LineString, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of positions (n, 2) to a line, (n,), m."""
    return np.asarray(shapely.distance(line, shapely.points(position)))


def _houses(course: Course, line: shapely.LineString, border: float, rng: np.random.Generator) -> Things:
    """Houses along the road, parallel or at right angles to it."""
    wanted = int(rng.integers(parameters.HOUSES[0], parameters.HOUSES[1] + 1))
    tries = 40
    station = rng.uniform(0, len(course.points) - 1, tries)
    index = station.astype(int)
    offset = rng.choice((-1.0, 1.0), tries) * rng.uniform(*parameters.HOUSE_DISTANCE, tries)
    position = course.points[index] + offset[:, None] * course.right[index]
    yaw = np.arctan2(course.right[index, 0], -course.right[index, 1]) + rng.integers(0, 4, tries) * math.pi / 2
    size = np.array(parameters.HOUSE_SIZE) * rng.uniform(0.85, 1.15, (tries, 3))
    tint = rng.uniform(0.85, 1.1, tries)
    free = _distance(line, position) > border + parameters.CLEARANCE + np.hypot(size[:, 0], size[:, 1])
    chosen: list[int] = []
    for i in np.flatnonzero(free).tolist():
        apart = [np.hypot(*(position[i] - position[j])) > 2.5 * parameters.HOUSE_SIZE[0] for j in chosen]
        if len(chosen) < wanted and all(apart):
            chosen.append(i)
    return Things(position[chosen], size[chosen], yaw[chosen], tint[chosen])


def _posts(course: Course, line: shapely.LineString, border: float) -> Things:
    """Delineators on both sides, except where the other side of a bend is in their way."""
    stations = np.arange(0.0, course.along[-1], parameters.POST_SPACING)
    centre = np.stack([np.interp(stations, course.along, course.points[:, i]) for i in (0, 1)], axis=1)
    index = np.searchsorted(course.along, stations, side="right") - 1
    right = course.right[index]
    offset = border + parameters.CLEARANCE
    position = np.concatenate((centre - offset * right, centre + offset * right))
    yaw = np.tile(np.arctan2(right[:, 0], -right[:, 1]), 2)
    free = _distance(line, position) > border + parameters.POST_WIDTH
    size = np.tile((parameters.POST_WIDTH / 2, parameters.POST_WIDTH / 2, parameters.POST_HEIGHT), (len(position), 1))
    return Things(position[free], size[free], yaw[free], np.ones(free.sum()))


def _plants(
    course: Course, line: shapely.LineString, border: float, houses: Things, rng: np.random.Generator
) -> dict[str, Things]:
    """Trees and bushes on a disturbed grid, thinned out to groves and single ones."""
    low, high = course.points.min(axis=0) - parameters.SURROUNDINGS, course.points.max(axis=0) + parameters.SURROUNDINGS
    columns, rows = np.ceil((high - low) / parameters.TREE_SPACING).astype(int).tolist()
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    count = len(grid)
    position = low + parameters.TREE_SPACING * (grid + rng.uniform(0.1, 0.9, (count, 2)))
    kind = rng.uniform(size=count)
    height = rng.uniform(*parameters.TREE_HEIGHT, count)
    bush = kind < parameters.BUSH_SHARE
    height[bush] = rng.uniform(*parameters.BUSH_HEIGHT, count)[bush]
    conifer = ~bush & (kind + 0.25 * _waves(position, rng) > 1.0 - parameters.CONIFER_SHARE)
    radius = height * np.where(bush, 0.65, np.where(conifer, 0.22, 0.33)) * rng.uniform(0.85, 1.15, count)
    distance = _distance(line, position)
    share = np.clip(parameters.GROVES[0] + parameters.GROVES[1] * _waves(position, rng), *parameters.GROVE_LIMITS)
    share[distance < parameters.ROADSIDE] *= parameters.ROADSIDE_SHARE
    size = np.stack((radius / math.sqrt(2), radius / math.sqrt(2), height), axis=1)
    far = distance > parameters.FAR_FROM_ROAD
    yaw, tint = rng.uniform(0.0, math.tau, count), rng.uniform(0.75, 1.25, count)
    kept = rng.uniform(size=count) < share
    kept &= distance > border + parameters.CLEARANCE + radius
    for house, reach in zip(houses.position, houses.reach, strict=True):
        kept &= np.hypot(*(position - house).T) > reach + radius
    return {
        name: Things(position[of & kept], size[of & kept], yaw[of & kept], tint[of & kept])
        for name, of in (
            ("broadleaf", ~bush & ~conifer & ~far),
            ("far broadleaf", ~bush & ~conifer & far),
            ("conifer", conifer & ~far),
            ("far conifer", conifer & far),
            ("bush", bush & ~far),
            ("far bush", bush & far),
        )
    }


def _waves(position: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Smooth random field with mean 0 and standard deviation 1: plane waves of 40 to 160 m."""
    count = 6
    direction, phase = rng.uniform(0.0, math.tau, (2, count))
    number = math.tau / rng.uniform(40.0, 160.0, count)
    waves = np.stack((np.cos(direction), np.sin(direction))) * number
    along = position[:, :1] * waves[0] + position[:, 1:] * waves[1]
    return np.asarray(np.cos(along + phase).sum(axis=1) / math.sqrt(count / 2))
