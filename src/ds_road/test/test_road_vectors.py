# SPDX-License-Identifier: Apache-2.0
"""Compares 200 roads with the values that the authors' package (maxitwo) computes for them."""

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
    """maxitwo's rule for the surface taken literally: quads_array pair of quadrilaterals is checked."""
    left, right = road.left_edge, road.right_edge
    quads = [shapely.Polygon((left[i], left[i + 1], right[i + 1], right[i])) for i in range(len(left) - 1)]
    if not all(quad.is_valid for quad in quads):
        return False
    if any(a.intersection(b).geom_type != "LineString" for a, b in pairwise(quads)):
        return False
    apart = np.array([(i, j) for i, j in combinations(range(len(quads)), 2) if j - i > 1])
    quads_array: NDArray[np.object_] = np.array(quads)
    return not shapely.intersects(quads_array[apart[:, 0]], quads_array[apart[:, 1]]).any()


def test_there_are_200_roads_of_three_kinds() -> None:
    kinds = [road["kind"] for road in ROADS]
    assert (kinds.count("generated"), kinds.count("mutated"), kinds.count("scrambled")) == (70, 70, 60)


@pytest.mark.parametrize("vector", ROADS, ids=range(len(ROADS)))
def test_road_equals_that_of_maxitwo(vector: dict[str, Any]) -> None:
    """Points agree to a micrometre, curvature to 1e-9, turns and validity exactly, for scrambled roads too.

    maxitwo bounds the control points, `Road` bounds the edges. The first assertion on validity checks that maxitwo's
    rule gives the expected value, the second that `Road` does.
    """
    road = Road(vector["control_points"])
    np.testing.assert_allclose(road.points, vector["road_points"], rtol=0, atol=1e-6)
    assert road.curvature == pytest.approx(vector["curvature"], rel=1e-9)
    assert road.turns_count == vector["turns_count"]
    assert road.turns_count_maxitwo == vector["turns_count_published"]
    inner = np.array(road.control_points[1:-1])
    in_box = inner.min() >= 0.0 and inner.max() <= 250.0
    assert (in_box and surface_is_valid(road)) == vector["valid"]
    assert road.validity.valid == vector["valid"], road.validity.reason
    assert bool(road.validity.reason) == (not road.validity.valid)


def test_a_maxitwo_compatible_road_starts_one_control_point_later() -> None:
    """maxitwo's spline of a mutant ignores the first control point: 96 samples instead of 115."""
    points = generate(np.random.default_rng(4)).control_points
    road = Road(points, maxitwo_compatible=True)
    assert road.maxitwo_compatible and road.control_points == points
    np.testing.assert_array_equal(road.points, Road(points[1:]).points)
    assert road.points.shape == (96, 2)
    np.testing.assert_allclose(road.points, Road(points).points[19:], atol=1e-9)
    assert len({road.road_id, Road(points).road_id, Road.from_road_points(points).road_id}) == 3
    np.testing.assert_allclose(road.reversed().points, road.points[::-1], atol=1e-9)
