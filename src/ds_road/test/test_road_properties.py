# SPDX-License-Identifier: Apache-2.0
"""Properties of every road and of its lanes, and inputs that are refused."""

from __future__ import annotations

import copy
import json
import math
import pickle
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import fresnel

from ds_base.palette import ASPHALT, GRASS, SERIES, rgb
from ds_road import (
    MutationError,
    Road,
    RoadError,
    Side,
    check,
    draw,
    generate,
    mutate,
    read_roads,
    road_from_fields,
    road_from_json,
    road_to_json,
    write_roads,
)
from ds_road.geometry import LANE_WINDOW, lane_curvature, largest_lane_curvature

seeds = st.integers(0, 10_000)


def random_road(seed: int, max_angle: int = 270) -> Road:
    return generate(np.random.default_rng(seed), max_angle=max_angle)


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from([20, 100, 270, 360]))
def test_generated_roads_are_valid_and_repeatable(seed: int, max_angle: int) -> None:
    road = random_road(seed, max_angle)
    assert road.validity.valid
    assert road == random_road(seed, max_angle) and hash(road) == hash(random_road(seed, max_angle))
    assert len(road.control_points) == 9 and len(road.points) == 115
    steps = np.diff(np.array(road.control_points), axis=0)
    np.testing.assert_allclose(np.hypot(*steps.T), 25.0, atol=1e-9)
    np.testing.assert_allclose(road.points[0], (125.0, 25.0), atol=1e-9)
    assert road.left_edge.min() >= 0.0 and road.right_edge.max() <= 250.0


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_a_mutant_moves_one_coordinate_of_one_inner_point(seed: int) -> None:
    road = random_road(seed)
    before = road.control_points
    mutant = mutate(road, np.random.default_rng(seed))
    delta = np.array(mutant.control_points) - np.array(before)
    assert mutant.validity.valid and road.control_points == before
    ((index, axis),) = np.argwhere(delta != 0.0)
    assert index in (4, 5, 6) and axis in (0, 1)
    assert delta[index, axis] == pytest.approx(round(delta[index, axis])) and 1 <= abs(round(delta[index, axis])) <= 6


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_reversing_a_road_swaps_its_lanes(seed: int) -> None:
    road = random_road(seed)
    reversed_road = road.reversed()
    assert reversed_road != road and reversed_road.reversed() == road
    np.testing.assert_allclose(reversed_road.points, road.points[::-1], atol=1e-9)
    assert reversed_road.length == pytest.approx(road.length)
    # Each direction leaves out its own last window; with one more point at the end, the road's last window counts too.
    longer = Road.from_road_points(np.vstack((road.points, 2 * road.points[-1] - road.points[-2])))
    assert longer.curvature == pytest.approx(max(road.curvature, reversed_road.curvature), rel=1e-9)


def test_a_road_is_immutable_and_survives_pickling() -> None:
    road = random_road(1)
    assert road.validity.valid and not road.left_edge.flags.writeable
    with pytest.raises(AttributeError):
        road.lane_width = 3.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        road.points[0] = 0.0
    for other in (pickle.loads(pickle.dumps(road)), copy.deepcopy(road)):
        assert other == road and other.road_id == road.road_id and not other.points.flags.writeable
    rest = ((9, 9), (20, 20), (30, 30))
    assert Road([(0.0, 0.0), *rest]).road_id == Road([(-0.0, 0), *rest]).road_id


def test_road_points_are_the_centre_line_itself() -> None:
    road = random_road(2)
    same = Road.from_road_points(road.points)
    assert same.sampled and not road.sampled
    np.testing.assert_array_equal(same.points, road.points)
    assert (same.validity, same.curvature, same.turns_count) == (road.validity, road.curvature, road.turns_count)
    assert same.reversed().reversed() == same
    with pytest.raises(MutationError, match="road points"):
        mutate(same, np.random.default_rng(0))


KINDS = ["plain", "maxitwo_compatible", "wide", "sampled", "left"]


def variant_of(seed: int, kind: str) -> Road:
    road = random_road(seed)
    if kind == "sampled":
        return Road.from_road_points(road.points, lane_width=3.5, lane="left")
    return Road(
        road.control_points,
        maxitwo_compatible=kind == "maxitwo_compatible",
        lane_width=5.0 if kind == "wide" else 4.0,
        lane="left" if kind == "left" else "right",
    )


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from(KINDS))
def test_json_round_trip_is_exact(seed: int, kind: str) -> None:
    road = variant_of(seed, kind)
    text = json.dumps(road_to_json(road))
    assert road_from_json(json.loads(text)) == road
    assert read_roads(text) == [road]
    assert read_roads(f" [{text}, {text}]") == [road, road]
    assert isinstance(json.loads(text), list) == (kind == "plain")


def test_files_hold_several_roads_or_one(tmp_path: Path) -> None:
    roads = [variant_of(seed, kind) for seed, kind in enumerate(KINDS)]
    write_roads(roads, tmp_path / "roads.json")
    assert read_roads(tmp_path / "roads.json") == read_roads(str(tmp_path / "roads.json")) == roads
    (tmp_path / "one.json").write_text(json.dumps(roads[0].control_points))
    assert read_roads(tmp_path / "one.json") == roads[:1]
    assert read_roads("[]") == []


FOUR = [[0, 0], [9, 9], [20, 20], [30, 30]]
BAD: dict[str, Any] = {
    "nan": [[0, 0], [1, 1], [math.nan, 2], [3, 3]],
    "infinity": [[0, 0], [1, 1], [math.inf, 2], [3, 3]],
    "one point": [[125, 25]],
    "too many points": [[float(i), 0.0] for i in range(100_000)],
    "huge": [[0, 0], [1e300, 0], [2, 0], [3, 0]],
    "equal neighbours": [[0, 0], [1, 1], [1, 1], [3, 3]],
    "three numbers": [[0, 0, 0], [1, 1, 1], [2, 2, 2], [3, 3, 3]],
    "text": [["a", "b"]] * 5,
    "nothing": None,
    "no points": {"control_points": None},
    "both kinds": {"control_points": [[0, 0]] * 4, "road_points": [[0, 0]] * 4},
    "a maxitwo_compatible road of road points": {"road_points": [[1, 1], [2, 2]], "maxitwo_compatible": True},
    "a maxitwo_compatible road too short": {"control_points": FOUR, "maxitwo_compatible": True},
    "maxitwo_compatible as text": {"control_points": FOUR, "maxitwo_compatible": "no"},
    "another lane": {"control_points": FOUR, "lane": "centre"},
    "no lane width": {"control_points": FOUR, "lane_width": None},
    "lane width nan": {"control_points": FOUR, "lane_width": math.nan},
    "neighbours too near": [[0, 0], [10, 10], [10, 10 + 1e-14], [40, 40]],
    "thousands of digits": [[0, 10**5000], [1, 1], [2, 2], [3, 3]],
    "a long string": "x" * 100_000,
    "booleans": [[True, False]] * 5,
    "a long point": [[0.0] * 100_000] * 5,
}


@pytest.mark.parametrize("raw", BAD.values(), ids=BAD.keys())
def test_invalid_input_is_refused_in_one_line(raw: Any) -> None:
    with pytest.raises(RoadError) as refused:
        road_from_json(raw)
    message = str(refused.value)
    assert "\n" not in message and len(message) < 200 and ("expected" in message or "remove" in message)
    started = time.process_time()
    result = check(raw)
    assert time.process_time() - started < 1.0
    assert result["valid"] is False and result["reason"] and result["length"] is None
    json.dumps(result, allow_nan=False)


NUMBERS = np.arange(1000)


def round_and_round(radius: Any, step: float) -> list[list[float]]:
    return np.column_stack((125 + radius * np.cos(step * NUMBERS), 125 + radius * np.sin(step * NUMBERS))).tolist()


WORST: dict[str, Any] = {
    "a hundred times round": round_and_round(30, 0.63),
    "a spiral": round_and_round(20 + NUMBERS / 12, 0.63),
    "a point a centimetre": [(50 + i / 100, 50 + i / 100) for i in range(1000)],
    "a millimetre on a bend": round_and_round(9, 0.002),
    "noise": np.random.default_rng(0).uniform(10, 240, (1000, 2)).tolist(),
    "there and reversed_road": [(100 + i % 2, 100) for i in range(1000)],
    "far away": [(9e5 + i, -9e5 + i % 7) for i in range(1000)],
}


@pytest.mark.parametrize("points", WORST.values(), ids=WORST.keys())
@pytest.mark.parametrize("kind", ["control_points", "road_points"])
def test_the_longest_roads_are_checked_in_a_second(points: Any, kind: str) -> None:
    started = time.process_time()
    result = check({kind: points})
    assert time.process_time() - started < 1.0
    json.dumps(result, allow_nan=False)
    assert result["length"] > 0


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ([(125, 25 * i) for i in range(15)], "box"),
        ([(50, 50), (50, 100), (50, 150), (100, 150), (100, 110), (20, 110), (10, 60)], "crosses"),
        ([(50, 50), (50, 75), (50, 100), (51, 76), (50, 52), (50, 30)], "folds"),
        ([(50, 20), (50, 50), (90, 50), (90, 90), (50, 90), (50, 50), (10, 50)], "start is its end"),
    ],
)
def test_an_invalid_road_gives_its_reason(points: list[tuple[float, float]], reason: str) -> None:
    assert reason in Road(points).validity.reason


def test_a_road_that_cannot_be_mutated_says_so() -> None:
    with pytest.raises(MutationError, match="no valid mutant"):
        mutate(Road([(125, 25 * i) for i in range(15)]), np.random.default_rng(0))


@pytest.mark.parametrize("asked", [{"max_angle": a} for a in (0, -5, 361)] + [{"box": b} for b in (99, 251, math.nan)])
def test_generation_refuses_what_is_out_of_range(asked: dict[str, Any]) -> None:
    with pytest.raises(RoadError, match="1 to 360|100 to 250"):
        generate(np.random.default_rng(0), **asked)


def test_roads_fit_a_smaller_box() -> None:
    for seed in range(5):
        road = generate(np.random.default_rng(seed), box=150)
        assert road.control_points[0] == (75.0, 0.0) and road.validity.valid
        edges = np.vstack((road.left_edge, road.right_edge))
        assert edges.min() >= 0.0 and edges.max() <= 150.0


def test_mutation_keeps_the_lanes_and_refuses_no_extent() -> None:
    wide = Road(random_road(3).control_points, lane_width=3.5)
    assert mutate(wide, np.random.default_rng(0)).lane_width == 3.5
    with pytest.raises(RoadError, match="at least 1"):
        mutate(wide, np.random.default_rng(0), extent=0)


def test_an_error_names_the_bad_road_of_a_file() -> None:
    good = random_road(1).control_points
    with pytest.raises(RoadError, match="road 1: a road has 2 control points, expected 4 to 1000"):
        read_roads(json.dumps([good, good[:2]]))
    with pytest.raises(RoadError, match=r"road 2: control point 1 is \[nan, 0\]"):
        read_roads(json.dumps([good, good, [[0, 0], [math.nan, 0], [1, 1], [2, 2]]]))
    with pytest.raises(RoadError, match=r"road 0: control point 1 is \['a', 0\]"):
        read_roads('[[0, 0], ["a", 0], [1, 1], [2, 2]]')


@pytest.mark.parametrize("text", ["", "{", '{"a": 1}', "nonsense", "1" * 5000, "[" * 100_000])
def test_a_file_without_a_list_of_roads_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "roads.json"
    path.write_text(text)
    with pytest.raises(RoadError, match="expected a list of roads"):
        read_roads(path)


def test_the_picture_shows_road_grass_and_trajectory() -> None:
    road = random_road(5)
    plain = draw(road)
    assert plain.dtype == np.uint8 and plain.shape[2] == 3
    assert max(draw(road, size=400, caption=False).shape) == 400
    colours = {tuple(c) for c in plain.reshape(-1, 3)[::7].tolist()}
    assert {rgb(ASPHALT), rgb(GRASS), (255, 255, 255)} <= colours
    assert not np.array_equal(plain, draw(road, trajectories={"bullet": road.right_lane_centre}))
    np.testing.assert_array_equal(plain, draw(road))


def test_every_control_point_has_a_star() -> None:
    """Stars are evenly spaced, as control points 25 m apart on a straight road must be."""
    picture = draw(Road([(125.0, 25.0 * i) for i in range(9)]), caption=False)
    red = (np.abs(picture.astype(int) - (215, 40, 40)).max(axis=2) < 10).any(axis=1)
    rows = np.flatnonzero(red)
    stars = np.split(rows, np.flatnonzero(np.diff(rows) > 3) + 1)
    assert len(stars) == 9
    spacing = np.diff([float(np.mean(star)) for star in stars])
    np.testing.assert_allclose(spacing, spacing.mean(), atol=3.0)


def test_a_trajectory_ends_in_a_disc_and_no_star_covers_it() -> None:
    road = Road([(125.0, 25.0 * i) for i in range(9)])
    path = np.array([(126.0, 25.0), (126.0, 100.0)])
    picture = draw(road, trajectories={"car": path}, caption=False).astype(int)
    assert not (np.abs(picture - (215, 40, 40)).max(axis=2) < 10).any()
    blue = (np.abs(picture - rgb(SERIES[0])).max(axis=2) < 10)[60:]  # below the legend
    rows = np.flatnonzero(blue.any(axis=1))
    wide = np.flatnonzero(blue.sum(axis=1) > 4)
    # 75 m up the straight road; its only wide part is the disc at the top, where it ends.
    assert len(rows) > 150 and 5 <= len(wide) <= 9 and wide[0] - rows[0] <= 1


@pytest.mark.parametrize("path", [np.zeros(4), np.full((3, 2), np.nan), np.zeros((3, 1))])
def test_the_picture_refuses_an_invalid_trajectory_or_size(path: Any) -> None:
    with pytest.raises(RoadError, match="trajectory car"):
        draw(random_road(1), trajectories={"car": path})
    with pytest.raises(RoadError, match="320 to 4000"):
        draw(random_road(1), size=10)


def test_a_trajectory_far_away_does_not_shrink_the_road() -> None:
    road = random_road(5)
    lane = road.right_lane_centre
    near, far = (draw(road, trajectories={"car": np.vstack((lane, lane[-1] + (0, d)))}) for d in (60.0, 1e12))
    assert near.shape == far.shape


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
