"""Roads against the values that the authors' package computes for 200 roads."""

from __future__ import annotations

import json
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from ds_road import Road, generate

ROADS: list[dict[str, Any]] = json.loads((Path(__file__).parent / "data" / "roads.json").read_text())["roads"]


def surface_is_valid(road: Road) -> bool:
    """maxitwo's rule for the surface, to the letter: every pair of quadrilaterals is looked at."""
    left, right = road.left_edge, road.right_edge
    quads = [shapely.Polygon((left[i], left[i + 1], right[i + 1], right[i])) for i in range(len(left) - 1)]
    if not all(quad.is_valid for quad in quads):
        return False
    if any(a.intersection(b).geom_type != "LineString" for a, b in pairwise(quads)):
        return False
    apart = np.array([(i, j) for i, j in combinations(range(len(quads)), 2) if j - i > 1])
    every: NDArray[np.object_] = np.array(quads)
    return not shapely.intersects(every[apart[:, 0]], every[apart[:, 1]]).any()


def in_box(points: NDArray[np.float64]) -> bool:
    return bool((points >= 0.0).all() and (points <= 250.0).all())


def test_there_are_200_roads_of_three_kinds() -> None:
    kinds = [road["kind"] for road in ROADS]
    assert (kinds.count("generated"), kinds.count("mutated"), kinds.count("scrambled")) == (70, 70, 60)


@pytest.mark.parametrize("vector", ROADS, ids=range(len(ROADS)))
def test_road_equals_the_published_one(vector: dict[str, Any]) -> None:
    """Points to a micrometre, curvature to 1e-9, turns and validity exactly, for scrambled roads too.

    No scrambled road differs. maxitwo bounds the control points and we bound the edges; the first assertion on
    validity shows that its rule gives the vector's answer, the second that ours does.
    """
    road = Road(vector["control_points"])
    np.testing.assert_allclose(road.points, vector["road_points"], rtol=0, atol=1e-6)
    assert road.curvature == pytest.approx(vector["curvature"], rel=1e-9)
    assert road.turns_count == vector["turns_count"]
    assert road.turns_count_maxitwo == vector["turns_count_published"]
    theirs = in_box(np.array(road.control_points[1:-1])) and surface_is_valid(road)
    assert theirs == vector["valid"]
    assert road.validity.valid == vector["valid"], road.validity.reason
    assert bool(road.validity.reason) == (not road.validity.valid)


def test_the_fast_check_of_the_surface_equals_the_slow_one() -> None:
    """Random roads inside the box, about as many that cross or fold as that do not."""
    rng = np.random.default_rng(1)
    answers: list[tuple[bool, bool]] = []
    while len(answers) < 80:
        turn = np.radians(rng.uniform(20, 140))
        heading = np.cumsum(rng.uniform(-turn, turn, 8))
        steps = rng.uniform(12, 25) * np.stack((np.cos(heading), np.sin(heading)), axis=1)
        road = Road(np.vstack(((0, 0), np.cumsum(steps, axis=0))) + (125, 125))
        if in_box(np.vstack((road.left_edge, road.right_edge))):
            answers.append((road.validity.valid, surface_is_valid(road)))
    assert [fast for fast, _ in answers] == [slow for _, slow in answers]
    assert 20 <= sum(fast for fast, _ in answers) <= 60


def test_a_published_road_starts_one_control_point_later() -> None:
    """maxitwo lays a mutant's spline through all but the first control point: 96 samples instead of 115."""
    points = generate(np.random.default_rng(4)).control_points
    road = Road(points, maxitwo_compatible=True)
    assert road.maxitwo_compatible and road.control_points == points
    np.testing.assert_array_equal(road.points, Road(points[1:]).points)
    assert road.points.shape == (96, 2)
    np.testing.assert_allclose(road.points, Road(points).points[19:], atol=1e-9)
    assert len({road.road_id, Road(points).road_id, Road.from_road_points(points).road_id}) == 3
    np.testing.assert_allclose(road.reversed().points, road.points[::-1], atol=1e-9)
