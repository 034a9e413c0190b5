"""What holds for every road, and what is refused."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from ds_road import MutationError, Road, RoadError, check, draw, generate, mutate, read_roads, write_roads

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
@given(seeds, st.floats(-math.pi, math.pi), st.floats(-50, 50), st.floats(-50, 50))
def test_features_do_not_depend_on_place_or_heading(seed: int, angle: float, dx: float, dy: float) -> None:
    road = random_road(seed)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    moved = Road(np.array(road.control_points) @ turn.T + (dx, dy))
    assert moved.curvature == pytest.approx(road.curvature, rel=1e-6)
    assert moved.length == pytest.approx(road.length, rel=1e-9)
    assert moved.turns_count == road.turns_count


def test_curvature_of_a_circle_is_one_over_its_radius() -> None:
    angle = np.linspace(0, 3, 30)
    road = Road(np.stack((30 * np.cos(angle), 30 * np.sin(angle)), axis=1))
    assert road.curvature == pytest.approx(1 / 30, rel=0.02)
    assert road.turns_count == 1


def test_a_straight_road_has_no_curvature_and_no_turn() -> None:
    road = Road([(125.0, 25.0 * i) for i in range(9)])
    assert (road.curvature, road.turns_count, road.curvature_bin) == (0.0, 0, 0)
    assert road.length == pytest.approx(150.0)
    np.testing.assert_allclose(road.right_lane_centre[:, 0], 127.0)


def test_spline_equals_a_hermite_spline_with_catmull_rom_tangents() -> None:
    """A centripetal Catmull-Rom segment is the cubic Hermite piece with its known tangents (SciPy as the oracle)."""
    points = np.array([(0.0, 0.0), (10.0, 2.0), (18.0, 11.0), (30.0, 9.0)])
    t = np.concatenate(([0.0], np.cumsum(np.sqrt(np.hypot(*np.diff(points, axis=0).T)))))

    def tangent(i: int) -> np.ndarray:
        before = (points[i] - points[i - 1]) / (t[i] - t[i - 1])
        after = (points[i + 1] - points[i]) / (t[i + 1] - t[i])
        weight = (t[i] - t[i - 1]) / (t[i + 1] - t[i - 1])
        result: np.ndarray = (1 - weight) * before + weight * after
        return result

    hermite = CubicHermiteSpline(t[1:3], points[1:3], [tangent(1), tangent(2)])
    np.testing.assert_allclose(Road(points).points, hermite(np.linspace(t[1], t[2], 20)), atol=1e-9)


def test_reversed_twice_is_the_same_road() -> None:
    road = random_road(3)
    assert road.reversed() != road and road.reversed().reversed() == road
    assert road.reversed().length == pytest.approx(road.length)


def test_json_round_trip_is_exact(tmp_path: Path) -> None:
    roads = [random_road(seed) for seed in range(3)]
    write_roads(roads, tmp_path / "roads.json")
    assert read_roads(tmp_path / "roads.json") == roads
    (tmp_path / "one.json").write_text(json.dumps(roads[0].control_points))
    assert read_roads(tmp_path / "one.json") == roads[:1]


BAD: dict[str, Any] = {
    "nan": [[0, 0], [1, 1], [math.nan, 2], [3, 3]],
    "infinity": [[0, 0], [1, 1], [math.inf, 2], [3, 3]],
    "one point": [[125, 25]],
    "too many points": [[float(i), 0.0] for i in range(100_000)],
    "huge": [[0, 0], [1e300, 0], [2, 0], [3, 0]],
    "huge integer": [[0, 0], [10**400, 0], [2, 0], [3, 0]],
    "equal neighbours": [[0, 0], [1, 1], [1, 1], [3, 3]],
    "three numbers": [[0, 0, 0], [1, 1, 1], [2, 2, 2], [3, 3, 3]],
    "text": [["a", "b"]] * 5,
    "digits as text": [["1", "2"], ["3", "4"], ["5", "6"], ["7", "8"]],
    "a number": 7,
    "nothing": None,
    "an object": {"road": 1},
    "empty": [],
}


@pytest.mark.parametrize("raw", BAD.values(), ids=BAD.keys())
def test_what_is_no_road_is_refused_in_one_line(raw: Any) -> None:
    with pytest.raises(RoadError) as refused:
        Road(raw)
    assert "\n" not in str(refused.value) and "expected" in str(refused.value) or "remove" in str(refused.value)
    started = time.monotonic()
    answer = check(raw)
    assert time.monotonic() - started < 1.0
    assert answer["valid"] is False and answer["reason"] and answer["length"] is None
    json.dumps(answer, allow_nan=False)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ([(125, 25 * i) for i in range(15)], "box"),
        ([(50, 50), (50, 100), (50, 150), (100, 150), (100, 110), (20, 110), (10, 60)], "crosses"),
        ([(50, 50), (50, 75), (50, 100), (51, 76), (50, 52), (50, 30)], "folds"),
    ],
)
def test_why_a_road_is_not_valid(points: list[tuple[float, float]], reason: str) -> None:
    assert reason in Road(points).validity.reason


def test_a_road_that_cannot_be_mutated_says_so() -> None:
    with pytest.raises(MutationError, match="no valid mutant"):
        mutate(Road([(125, 25 * i) for i in range(15)]), np.random.default_rng(0))


@pytest.mark.parametrize("angle", [0, -5, 361])
def test_generation_refuses_angles_out_of_range(angle: int) -> None:
    with pytest.raises(RoadError, match="1 to 360"):
        generate(np.random.default_rng(0), max_angle=angle)


@pytest.mark.parametrize("text", ["", "{", '{"a": 1}', "nonsense"])
def test_a_file_that_is_no_list_of_roads_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "roads.json"
    path.write_text(text)
    with pytest.raises(RoadError, match="expected a list of roads"):
        read_roads(path)


def test_the_picture_shows_road_grass_and_trajectory() -> None:
    road = random_road(5)
    plain = draw(road)
    assert plain.dtype == np.uint8 and plain.shape[2] == 3
    colours = {tuple(c) for c in plain.reshape(-1, 3)[::7].tolist()}
    assert {(105, 105, 110), (120, 165, 105)} <= colours
    assert not np.array_equal(plain, draw(road, trajectories={"bullet": road.right_lane_centre}))
    np.testing.assert_array_equal(plain, draw(road))
