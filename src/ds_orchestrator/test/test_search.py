# SPDX-License-Identifier: Apache-2.0
"""Searches through ask and tell, with a synthetic fitness and without simulators, and features by hand."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from ds_orchestrator.search.algorithms import (
    SEARCHES,
    Archive,
    ConditionSpace,
    DeepHyperion,
    DeepHyperionCS,
    RandomSearch,
    Search,
    SearchedCondition,
    SearchSettings,
)
from ds_orchestrator.search.features import Cell, FeatureError, cell_of, feature_of
from ds_road import Road, generate
from ds_sim.conditions.model import FIELDS, Conditions, ConditionsError
from ds_sim.scenario import Scenario
from ds_sim.testing import STRAIGHT

SETTINGS = SearchSettings(population=5, iterations=12, min_angle=60, max_angle=120)


def place_of(road: Road) -> Cell:
    return road.turns_count, int(100 * road.curvature)


def fitness_of(road: Road) -> float:
    """Compute a fixed function of the road that is sometimes negative."""
    return 1.5 - 12.0 * road.curvature


def replayed(kind: type[Search], settings: SearchSettings, seed: int) -> tuple[Search, list[Road]]:
    """Ask for all roads; some outcomes are errors, so that these are replayed as well."""
    search = kind(settings, np.random.default_rng(seed))
    roads: list[Road] = []
    while not search.done:
        roads.append(search.ask())
        search.tell(None if len(roads) % 7 == 0 else fitness_of(roads[-1]))
    return search, roads


def changes(roads: list[Road]) -> list[int]:
    """In how many coordinates each road after the population differs from the nearest earlier one."""
    points = np.array([road.control_points for road in roads])
    return [
        int((points[index] != points[:index]).sum(axis=(1, 2)).min())
        for index in range(SETTINGS.population, len(roads))
    ]


def test_mutants_come_from_elites_and_random_search_mutates_nothing() -> None:
    assert max(changes(replayed(DeepHyperion, SETTINGS, 3)[1])) <= 1
    assert min(changes(replayed(RandomSearch, SETTINGS, 3)[1])) > 2


def test_the_archive_holds_the_lowest_fitness_of_each_cell_but_keeps_a_failure() -> None:
    """Against a simple reference: local competition, and an elite that failed is never replaced."""
    settings = SearchSettings(population=20, iterations=60, min_angle=60, max_angle=300)
    search, roads = replayed(DeepHyperion, settings, 4)
    expected: dict[Cell, float] = {}
    for road in (one for number, one in enumerate(roads, start=1) if number % 7):
        cell, fitness = place_of(road), fitness_of(road)
        if cell not in expected or (expected[cell] >= 0 and fitness < expected[cell]):
            expected[cell] = fitness
    assert {cell: elite.fitness for cell, elite in search.archive.items()} == expected
    assert min(expected.values()) < 0 < max(expected.values())
    assert all(place_of(elite.road) == cell for cell, elite in search.archive.items())


def test_a_car_that_got_stuck_in_its_lane_has_failed() -> None:
    """Its fitness is above 0; a road on which the driver came closer to the edge but completed does not replace it."""
    search = DeepHyperion(SearchSettings(population=1, iterations=60, extent=1), np.random.default_rng(3))
    road = search.ask()
    search.tell(1.9, failed=True)
    stuck = search.archive[place_of(road)]
    while not search.done:
        search.ask()
        search.tell(1.0)
    assert stuck.failed and search.archive[place_of(road)] == stuck


def test_an_error_changes_no_archive_and_costs_one_iteration() -> None:
    search = DeepHyperion(SETTINGS, np.random.default_rng(1))
    for _ in range(search.budget):
        search.ask()
        search.tell(None)
    assert search.done and search.archive == {}


def test_ask_and_tell_take_turns() -> None:
    search = DeepHyperion(SearchSettings(population=1, iterations=0), np.random.default_rng(1))
    with pytest.raises(RuntimeError, match="ask for one first"):
        search.tell(1.0)
    search.ask()
    with pytest.raises(RuntimeError, match="tell the fitness"):
        search.ask()
    search.tell(1.0)
    with pytest.raises(RuntimeError, match="budget"):
        search.ask()


@pytest.mark.parametrize("kind", SEARCHES.values())
def test_every_search_is_replayed_by_its_seed_and_outcomes(kind: type[Search]) -> None:
    first, roads = replayed(kind, SETTINGS, 5)
    second, again = replayed(kind, SETTINGS, 5)
    assert roads == again and first.archive == second.archive
    assert roads != replayed(kind, SETTINGS, 6)[1]
    assert all(road.validity.valid for road in roads) and len(roads) == SETTINGS.budget


CROWDED = SearchSettings(population=1, iterations=200, extent=1)
"""A road has 12 neighbours at most, so that mutants often repeat a road."""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", SEARCHES.values())
def test_no_search_asks_for_a_road_twice(kind: type[Search], seed: int) -> None:
    _, roads = replayed(kind, CROWDED, seed)
    assert len({road.road_id for road in roads}) == len(roads) == CROWDED.budget


def test_a_road_comes_again_only_under_other_conditions() -> None:
    searched = ConditionSpace([SearchedCondition(name="visibility", low=20.0, high=200.0)])
    search = DeepHyperion(dataclasses.replace(CROWDED, conditions=searched), np.random.default_rng(1))
    asked = []
    while not search.done:
        asked.append(search.ask_test())
        search.tell(fitness_of(asked[-1].road))
    assert len({(one.road.road_id, one.conditions) for one in asked}) == len(asked)
    assert len({one.road.road_id for one in asked}) < len(asked)


def test_a_search_as_in_maxitwo_repeats_roads_as_maxitwo_does() -> None:
    _, roads = replayed(DeepHyperion, dataclasses.replace(CROWDED, maxitwo_compatible=True), 0)
    assert len({road.road_id for road in roads}) < len(roads)


def test_a_search_whose_mutants_are_all_known_draws_random_roads() -> None:
    class Stuck(DeepHyperion):
        def _next(self) -> tuple[Road, Conditions]:
            return next(iter(self.archive.values())).road, Conditions()

    _, roads = replayed(Stuck, dataclasses.replace(CROWDED, iterations=5), 0)
    assert len({road.road_id for road in roads}) == 6


def test_every_search_begins_with_the_same_random_roads() -> None:
    """The baseline differs from the others after the initial population, not in how roads are drawn."""
    begun = [replayed(kind, SETTINGS, 5)[1][: SETTINGS.population] for kind in SEARCHES.values()]
    assert begun[0] == begun[1] == begun[2]


def test_maxitwo_compatible_is_one_iteration_more_and_mutants_without_their_first_control_point() -> None:
    settings = SearchSettings(population=3, iterations=4, min_angle=60, max_angle=120, maxitwo_compatible=True)
    search, roads = replayed(DeepHyperion, settings, 2)
    assert len(roads) == 3 + 4 + 1
    assert [road.maxitwo_compatible for road in roads] == [False] * 3 + [True] * 5
    for mutant in roads[3:]:
        assert len(mutant.control_points) == 9 and len(mutant.points) == 96
        np.testing.assert_array_equal(mutant.points[0], mutant.control_points[2])
    for cell, elite in search.archive.items():
        assert cell == (elite.road.turns_count_maxitwo, int(100 * elite.road.curvature))


def test_contribution_is_the_share_of_mutants_that_entered_the_archive() -> None:
    """With outcomes set by hand: the only cell is the parent, and the fitness decides whether a mutant is placed."""
    settings = SearchSettings(population=1, iterations=4, min_angle=60, max_angle=60)
    search = DeepHyperionCS(settings, np.random.default_rng(4))
    search.ask()
    search.tell(1.0, cell=(0, 0))
    assert search.contribution((0, 0)) == 1.0
    # Not better than the elite of their cell; an error does not change the parent's score.
    for fitness in (1.5, 1.2, None):
        search.ask()
        search.tell(fitness, cell=(0, 0))
        assert search.contribution((0, 0)) == 0.0
    search.ask()
    search.tell(1.5, cell=(5, 5))  # placed, since its cell is empty
    assert search.contribution((0, 0)) == pytest.approx(1 / 3)
    assert search.contribution((5, 5)) == 1.0


def test_cells_of_higher_rank_are_selected_more_often() -> None:
    """Half of the draws are uniform, half by linear ranking, whose density falls from 1.5 to 0.5 over the ranks."""
    settings = SearchSettings(population=4, iterations=4000)
    search = DeepHyperionCS(settings, np.random.default_rng(1))
    for k in range(4):
        search.ask()
        search.tell(1.0, cell=(k, 0))
    for k in range(4):  # cell k has had k + 1 mutants, one of which was placed
        search._mutants[(k, 0)] = [True] + [False] * k
    counts = np.zeros(4)
    for _ in range(4000):
        counts[next(search._choices())[0]] += 1
    # Linear ranking: share of the ranks [a, b) of 1 is 1.5 (b - a) - (b^2 - a^2) / 2; the other half is uniform.
    edges = np.arange(5) / 4
    ranked = 1.5 * np.diff(edges) - np.diff(edges**2) / 2
    np.testing.assert_allclose(counts / 4000, 0.5 * ranked + 0.5 / 4, atol=0.025)


def test_the_archive_keeps_the_elites_that_pyribs_keeps() -> None:
    """The same sequence in `ribs.archives.GridArchive`, whose objective is the negated fitness; failures tie."""
    if int(np.__version__.partition(".")[0]) < 2:
        pytest.skip("ribs needs NumPy 2")
    GridArchive = pytest.importorskip("ribs.archives").GridArchive

    rng = np.random.default_rng(11)
    road = generate(rng)
    archive = Archive()
    theirs = GridArchive(solution_dim=1, dims=[6, 8], ranges=[(0, 6), (4, 12)])
    for index in range(600):
        cell = (int(rng.integers(6)), int(rng.integers(4, 12)))
        fitness = float(rng.uniform(-0.3, 2.0))
        stuck = bool(rng.random() < 0.05)
        placed = archive.place(cell, Scenario(road, seed=1), fitness, failed=stuck)
        # Every failure counts the same, as the paper's constant of -0.1 does (maxitwo).
        objective = 0.1 if stuck or fitness < 0 else -fitness
        status = theirs.add_single([index], objective, np.array(cell) + 0.5)["status"]
        assert placed == (int(status) > 0)
    data = theirs.data()
    places = map(tuple, np.floor(data["measures"]).astype(int).tolist())
    found = dict(zip(places, -data["objective"], strict=True))
    assert set(found) == set(archive)
    for place, elite in archive.items():
        assert found[place] == pytest.approx(-0.1 if elite.failed else elite.fitness)
    assert 0 < sum(elite.failed for elite in archive.values()) < len(archive)


SPACE = ConditionSpace(
    (
        SearchedCondition(name="line_contrast", low=0.05, high=1.0),
        SearchedCondition(name="visibility", low=20.0, high=200.0, step=0.1),
        SearchedCondition(name="camera_pitch", low=-0.1, high=0.05),
    ),
    Conditions(payload=0.2),
)


def fogged(kind: type[Search], seed: int) -> tuple[Search, list[Scenario]]:
    settings = SearchSettings(population=8, iterations=60, min_angle=60, max_angle=120, conditions=SPACE)
    search, tests = kind(settings, np.random.default_rng(seed)), []
    while not search.done:
        tests.append(search.ask_test())
        road, conditions = tests[-1].road, tests[-1].conditions
        cell = cell_of(road, features=["curvature", "line_contrast"], conditions=conditions)
        search.tell(fitness_of(road) + conditions.line_contrast, cell=cell)
    return search, tests


@pytest.mark.parametrize("kind", SEARCHES.values())
def test_a_search_of_conditions_is_replayed_and_stays_in_range(kind: type[Search]) -> None:
    search, tests = fogged(kind, 5)
    again, same = fogged(kind, 5)
    assert tests == same and search.archive == again.archive and tests != fogged(kind, 6)[1]
    for test in tests:
        for one in SPACE.searched:
            assert one.low <= getattr(test.conditions, one.name) <= one.high
        assert set(test.conditions.changed) <= {"payload", *(one.name for one in SPACE.searched)}
        assert test.conditions.payload == 0.2
    for cell, elite in search.archive.items():
        assert cell[1] == min(int(10 * elite.conditions.line_contrast + 1e-9), 9)
    with pytest.raises(RuntimeError, match="ask for a test"):
        kind(SearchSettings(conditions=SPACE), np.random.default_rng(1)).ask()


def test_a_mutation_changes_the_road_or_one_condition() -> None:
    _, tests = fogged(DeepHyperion, 7)
    kinds = Counter()  # type: ignore[var-annotated]
    for index, test in enumerate(tests[8:], start=8):
        changes = []
        for parent in tests[:index]:
            names = {n for n in FIELDS if getattr(parent.conditions, n) != getattr(test.conditions, n)}
            changes.append((parent.road != test.road, len(names)))
        closest = min(changes, key=sum)
        assert closest in ((True, 0), (False, 1))
        kinds[closest] += 1
    assert all(count > 10 for count in kinds.values()) and len(kinds) == 2


def test_conditions_that_are_not_searched_draw_no_random_numbers() -> None:
    """The paper's search asks for the same roads, whatever conditions are fixed."""
    _, plain = replayed(DeepHyperion, SETTINGS, 3)
    search = DeepHyperion(dataclasses.replace(SETTINGS, conditions=ConditionSpace(())), np.random.default_rng(3))
    fixed = ConditionSpace((), Conditions(visibility=60.0))
    foggy = DeepHyperion(dataclasses.replace(SETTINGS, conditions=fixed), np.random.default_rng(3))
    for number, road in enumerate(plain, start=1):
        test = foggy.ask_test()
        assert search.ask() == test.road == road and test.conditions.visibility == 60.0
        for one in (search, foggy):
            one.tell(None if number % 7 == 0 else fitness_of(road))


def test_steps_are_within_a_share_of_the_scale_and_reflected() -> None:
    rng = np.random.default_rng(2)
    fog = SearchedCondition(name="visibility", low=20.0, high=200.0, step=0.1)
    steps = [1.0 / fog.mutated(50.0, rng) - 1.0 / 50.0 for _ in range(400)]
    assert 0.9 < max(map(abs, steps)) / (0.1 * (1 / 20 - 1 / 200)) <= 1.0 + 1e-9  # even in the extinction of the air
    ends = [fog.mutated(20.0, rng) for _ in range(400)]
    assert len(set(ends)) == 400 and min(ends) >= 20.0  # not held at the end
    drawn = [fog.draw(rng) for _ in range(400)]
    assert abs(np.mean([1.0 / value for value in drawn]) - (1 / 20 + 1 / 200) / 2) < 0.002


@pytest.mark.parametrize(
    ("searched", "fixed", "problem"),
    [
        ([("rain", 0.0, 1.0)], {}, "unknown condition 'rain'"),
        ([("visibility", 20.0, math.inf)], {}, "finite range within 20 m or more"),
        ([("friction", 0.5, 0.2)], {}, "within 0.1 to 1"),
        ([("friction", 0.2, 0.5), ("friction", 0.2, 0.6)], {}, "searched twice"),
        ([("friction", 0.2, 0.5)], {"friction": 0.3}, "fixed and searched"),
        ([("shadow_depth", 0.0, 0.5)], {}, "give shadow_density too"),
    ],
)
def test_ranges_that_cannot_be_searched_are_refused(
    searched: list[tuple[str, float, float]], fixed: dict[str, float], problem: str
) -> None:
    with pytest.raises(ConditionsError, match=problem):
        ConditionSpace(tuple(SearchedCondition(name=n, low=a, high=b) for n, a, b in searched), Conditions(**fixed))


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
    for road, radius in ((circle(20.0), 22), (circle(20.0).in_lane("left"), 18)):
        assert cell_of(road, features=["lane_curvature", "turns_count"]) == (int(100 / radius), 1)
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
