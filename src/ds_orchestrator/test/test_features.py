# SPDX-License-Identifier: Apache-2.0
"""Features against values computed by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_orchestrator.search.features import FEATURES, FeatureError, cell_of, feature_of
from ds_road import Road, generate
from ds_sim.conditions.model import Conditions

STRAIGHT = Road([(125.0, 25.0 * k) for k in range(9)])


@dataclass
class Driven:
    steering: NDArray[np.float64]
    trajectory: NDArray[np.float64]


def circle(radius: float) -> Road:
    """Create half a circle to the left, as points."""
    angle = np.linspace(0, np.pi, 100)
    return Road.from_road_points(np.stack((125 + radius * np.cos(angle), 50 + radius * np.sin(angle)), axis=1))


def test_features_of_a_straight_road() -> None:
    names = ["turns_count", "curvature", "minimum_radius", "direction_coverage", "segment_count"]
    # 90 m in feet; one direction of 26 ends of bins.
    assert cell_of(STRAIGHT, features=names) == (0, 0, 295, 3, 0)


def test_features_of_half_a_circle() -> None:
    road = circle(20.0)
    # 20 m are 65.6 feet; from north to south over west there are the bins from 0 to 180 degrees, 13 of 26.
    cell = cell_of(road, features=["minimum_radius", "turns_count"])
    assert cell == (65, 1) and road.curvature == pytest.approx(0.05)
    assert cell_of(road, features=["direction_coverage", "turns_count"]) == (50, 1)


def test_lanes_of_half_a_circle_have_their_own_curvature() -> None:
    """To the left by 20 m: the right lane has 22 m, the left one 18 m, whichever is driven."""
    driven = [f"{lane}lane_curvature_max_{side}" for lane in ("", "other_") for side in ("right", "left")]
    assert cell_of(circle(20.0), features=driven) == (0, int(100 / 22), 0, int(100 / 18))
    assert cell_of(circle(20.0).in_lane("left"), features=driven) == (0, int(100 / 18), 0, int(100 / 22))
    assert cell_of(circle(20.0).mirrored(), features=driven) == (int(100 / 22), 0, int(100 / 18), 0)
    assert feature_of("lane_curvature_max_right").label(17) == "0.17"


def test_direction_coverage_counts_bins_of_the_angle_to_north() -> None:
    """By hand: steps to the north, to the east, and at 100 degrees: bins 1, 7 (86.4 to 100.8 degrees) and 7 again."""
    far = [(0.0, 0.0), (0.0, 10.0), (10.0, 10.0), (10.0 + np.sin(np.radians(100)), 10.0 + np.cos(np.radians(100)))]
    assert cell_of(Road.from_road_points(far), features=["direction_coverage", "turns_count"])[0] == int(100 * 2 / 26)  # type: ignore[index]


def test_features_of_the_run_need_the_run() -> None:
    path = np.zeros((4, 5))
    path[:, 4] = [0.5, -0.5, 0.25, -0.24]
    driven = Driven(np.array([0.3, -0.3, 0.3, -0.3]), path)
    names = ["steering_deviation", "mean_lateral_position"]
    assert cell_of(STRAIGHT, driven, features=names) == (30, 37)  # mean of the absolute values: 0.3725 m
    assert cell_of(STRAIGHT, features=names) is None
    assert cell_of(STRAIGHT, features=["turns_count", "steering_deviation"]) is None
    nothing = Driven(np.empty(0), np.empty((0, 5)))
    assert cell_of(STRAIGHT, nothing, features=names) == (0, 0)


def test_a_width_makes_bins_of_several() -> None:
    road = circle(20.0)
    radius, wide = (cell_of(road, features=[name, "turns_count"]) for name in ("minimum_radius", "minimum_radius:20"))
    assert radius is not None and wide is not None and wide[0] == radius[0] // 20 == 3
    assert feature_of("minimum_radius:20").label(3) == "60" and feature_of("curvature:2").label(8) == "0.16"


@pytest.mark.parametrize("name", ["turns", "curvature:", "curvature:0", "curvature:x", ""])
def test_unknown_names_are_refused(name: str) -> None:
    with pytest.raises(FeatureError, match="expected"):
        feature_of(name)


def test_maxitwo_compatible_counts_turns_with_its_own_constants() -> None:
    roads = [generate(np.random.default_rng(s), max_angle=300) for s in range(30)]
    cells = [cell_of(road, maxitwo_compatible=True) for road in roads]
    assert cells == [(road.turns_count_maxitwo, int(100 * road.curvature)) for road in roads]
    assert cells != [cell_of(road) for road in roads]
    assert set(FEATURES) >= {"turns_count", "curvature"}


def test_an_axis_of_a_condition_is_even_on_its_scale() -> None:
    def bins(name: str, **values: float) -> int | None:
        cell = cell_of(STRAIGHT, features=[name, "turns_count"], conditions=Conditions(**values))
        return None if cell is None else cell[0]

    assert [bins("line_contrast", line_contrast=v) for v in (0.0, 0.09, 0.1, 0.3, 1.0)] == [0, 0, 1, 3, 9]
    # Even in the extinction of the air, 1 / V: 40 m is half of it, clear air none of it.
    assert [bins("visibility", visibility=v) for v in (20.0, 40.0, 200.0, 1e6, math.inf)] == [0, 5, 9, 9, 9]
    assert bins("exposure", exposure=1.0) == 5 and bins("line_contrast:5", line_contrast=0.6) == 1
    assert [feature_of("visibility").label(k) for k in (0, 5, 10)] == ["20", "40", "inf"]
    assert feature_of("line_contrast:5").label(1) == "0.5"
    assert bins("pavement_reflectance") is None  # as each simulator has it: no value, no cell
    for lane, radius in (("right", 22), ("left", 18)):
        road = circle(20.0).in_lane(lane)  # type: ignore[arg-type]
        assert cell_of(road, features=["lane_curvature", "turns_count"]) == (int(100 / radius), 1)
