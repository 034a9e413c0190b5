# SPDX-License-Identifier: Apache-2.0
"""Driven lanes, and the curvature of lanes against circles and clothoids."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import fresnel

from ds_road import Road, Side, generate, mutate, road_from_fields, road_from_json, road_to_json
from ds_road.geometry import LANE_WINDOW, lane_curvature, largest_lane_curvature

HARD = [generate(np.random.default_rng(seed)) for seed in range(12)]


def arc(radius: float, angle: float, side: Side) -> Road:
    """Create a centre line that turns by `angle` to one side, with two lanes of 4 m."""
    turned = np.linspace(0.0, angle, 80)
    x, y = radius * (1.0 - np.cos(turned)), radius * np.sin(turned)
    return Road.from_road_points(np.stack((125 + (x if side == "right" else -x), 100 + y), axis=1))


@pytest.mark.parametrize("side", ["right", "left"])
def test_lanes_of_a_circle_have_their_own_radii(side: Side) -> None:
    """A bend to the right of 20 m has a right lane of 18 m and a left one of 22 m."""
    sides: tuple[Side, Side] = ("right", "left")
    for lane in sides:
        road = arc(20.0, 2.5, side).in_lane(lane)
        found = {"right": road.lane_curvature_max_right, "left": road.lane_curvature_max_left}
        assert found.pop(side) == pytest.approx(1.0 / (18.0 if lane == side else 22.0), rel=2e-3)
        assert [*found.values()] == [0.0]


def test_curvature_of_a_clothoid_is_that_of_the_middle_of_the_window() -> None:
    """Curvature grows linearly with arc length, so its mean over a window is its value in the middle."""
    sharpness, length = 0.004, 60.0
    s = np.linspace(0.0, length, 100)
    scale = math.sqrt(math.pi / sharpness)
    to_the_left, ahead = fresnel(s / scale)
    line = scale * np.stack((to_the_left, ahead), axis=1)  # heads north, turns right
    step = length / 99
    places = np.arange(3.0, length - 3.0, 0.7)
    np.testing.assert_allclose(lane_curvature(line, places), sharpness * places, rtol=2e-3)
    assert largest_lane_curvature(line, "right") == pytest.approx(
        sharpness * (length - step / 2 - LANE_WINDOW / 2), rel=1e-3
    )
    assert largest_lane_curvature(line * (-1.0, 1.0), "left") == largest_lane_curvature(line, "right")
    assert largest_lane_curvature(line, "left") == 0.0


def test_a_kink_is_spread_over_the_window() -> None:
    """0.4 rad within the window are 0.1 1/m, wherever the samples lie; a shorter lane goes on straight."""
    for spacing in (0.5, 1.0, 1.3):
        before = np.stack((np.zeros(20), np.arange(20.0) * spacing), axis=1)
        after = before[-1] + np.arange(1, 20)[:, None] * spacing * np.array((math.sin(0.4), math.cos(0.4)))
        assert largest_lane_curvature(np.vstack((before, after)), "right") == pytest.approx(0.1, rel=1e-9)
    short = np.array(((0.0, 0.0), (0.0, 1.0), (math.sin(0.4), 1.0 + math.cos(0.4))))
    assert largest_lane_curvature(short, "right") == pytest.approx(0.1)
    assert largest_lane_curvature(short[:2], "right") == largest_lane_curvature(short, "left") == 0.0


@pytest.mark.parametrize("road", HARD[:6], ids=lambda road: road.road_id)
def test_the_largest_curvature_is_found_between_samples_too(road: Road) -> None:
    """Against windows every millimetre of the lane."""
    line: NDArray[np.float64] = road.lane_centre
    steps = np.diff(line, axis=0)
    lengths = np.hypot(*steps.T)
    middles, headings = np.cumsum(lengths) - lengths / 2, np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    begins = np.arange(middles[0], middles[-1] - LANE_WINDOW, 1e-3)
    turned = np.interp(begins + LANE_WINDOW, middles, headings) - np.interp(begins, middles, headings)
    assert road.lane_curvature_max_right == pytest.approx(-turned.min() / LANE_WINDOW, abs=1e-4)
    assert road.lane_curvature_max_left == pytest.approx(turned.max() / LANE_WINDOW, abs=1e-4)


@pytest.mark.parametrize("road", HARD, ids=lambda road: road.road_id)
def test_the_mirror_image_swaps_left_and_right(road: Road) -> None:
    image = road.mirrored()
    assert image.lane == "left" and image.road_id != road.road_id and image.validity.valid
    np.testing.assert_allclose(image.lane_centre, road.lane_centre * (-1, 1) + (250, 0), atol=1e-9)
    np.testing.assert_allclose(image.other_lane_centre, road.other_lane_centre * (-1, 1) + (250, 0), atol=1e-9)
    assert image.lane_curvature_max_left == pytest.approx(road.lane_curvature_max_right, abs=1e-9)
    assert image.lane_curvature_max_right == pytest.approx(road.lane_curvature_max_left, abs=1e-9)
    # Forth and back within the rounding of a coordinate.
    np.testing.assert_allclose(image.mirrored().control_points, road.control_points, rtol=0, atol=1e-12)
    assert image.mirrored().lane == "right"


def test_the_lane_is_part_of_the_road() -> None:
    road = HARD[0]
    left = road.in_lane("left")
    assert left != road and left.road_id != road.road_id and left.in_lane("right") == road
    assert np.array_equal(left.lane_centre, road.left_lane_centre)
    assert np.array_equal(left.points, road.points) and left.validity == road.validity
    # The lane that keeps its name on the way back is the other strip of the surface.
    back = left.reversed()
    assert back.lane == "left" and back == road.reversed().in_lane("left")
    assert mutate(left, np.random.default_rng(0)) == mutate(road, np.random.default_rng(0)).in_lane("left")
    assert generate(np.random.default_rng(0), lane="left") == road.in_lane("left")
    for odd in (Road(road.control_points, maxitwo_compatible=True, lane_width=3.0), Road.from_road_points(road.points)):
        assert odd.in_lane("left").in_lane("right") == odd != odd.in_lane("left")
        assert odd.mirrored().lane_width == odd.lane_width and odd.mirrored().sampled == odd.sampled


@pytest.mark.parametrize(("lane", "border", "lines"), [("middle", 3.0, 3), ("single", 1.5, 2)])
def test_lanes_in_the_middle_are_driven_on_the_centre_line(lane: Side, border: float, lines: int) -> None:
    """A road of 3 m lanes northwards: two of them with a centre line, or a single one between two lines."""
    plain = Road([(125.0, 25.0 * i) for i in range(5)], lane_width=3.0)
    road = plain.in_lane(lane)
    for driven in (road.lane_centre, road.other_lane_centre):
        np.testing.assert_array_equal(driven, road.points)
    np.testing.assert_allclose(road.right_edge[:, 0] - road.points[:, 0], border)
    np.testing.assert_allclose(road.points[:, 0] - road.left_edge[:, 0], border)
    assert road.has_centre_line is (lines == 3) and road.mirrored().lane == road.reversed().lane == lane
    assert len({road.road_id, plain.road_id, plain.in_lane("left").road_id}) == 3
    assert road_from_json(road_to_json(road)) == road and lane in repr(road)
    fields = {"lane_width": 3.0, "road_id": road.road_id}
    assert road_from_fields(road.control_points, **fields) == road  # type: ignore[arg-type]
    assert road_from_fields(road.control_points, lane_width=3.0, road_id="of another one").lane == "right"
