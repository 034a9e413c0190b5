"""DeepHyperion in microseconds: no simulator, no clock, only ask and tell."""

from __future__ import annotations

import numpy as np
import pytest

from ds_orchestrator.features import Cell
from ds_orchestrator.search import DeepHyperion, SearchSettings
from ds_road import Road

SETTINGS = SearchSettings(population=5, iterations=12, min_angle=60, max_angle=120)


def cell_of(road: Road) -> Cell:
    return road.turns_count, road.curvature_bin


def fitness_of(road: Road) -> float:
    """Any fixed function of the road that is sometimes negative."""
    return 1.5 - 12.0 * road.curvature


def run(seed: int, settings: SearchSettings = SETTINGS) -> tuple[DeepHyperion, list[Road]]:
    search = DeepHyperion(settings, np.random.default_rng(seed))
    roads = []
    while not search.done:
        roads.append(search.ask())
        search.tell(fitness_of(roads[-1]))
    return search, roads


def test_the_budget_is_population_plus_iterations_and_the_seed_decides() -> None:
    search, roads = run(1)
    assert len(roads) == search.budget == 17
    assert roads == run(1)[1] and roads != run(2)[1]
    assert all(road.validity.valid for road in roads)


def test_mutants_come_from_elites() -> None:
    """Each road after the population differs from an earlier one in one coordinate of one control point."""
    _, roads = run(3)
    for index in range(SETTINGS.population, len(roads)):
        points = np.array(roads[index].control_points)
        differences = [np.count_nonzero(points != np.array(r.control_points)) for r in roads[:index]]
        assert min(differences) <= 1


def test_the_archive_holds_the_lowest_fitness_of_each_cell_but_keeps_a_failure() -> None:
    """Replayed by a plain reference: local competition, and an elite that fails already is never replaced."""
    search, roads = run(4, SearchSettings(population=20, iterations=60, min_angle=60, max_angle=300))
    expected: dict[Cell, float] = {}
    for road in roads:
        cell, fitness = cell_of(road), fitness_of(road)
        if cell not in expected or (expected[cell] >= 0 and fitness < expected[cell]):
            expected[cell] = fitness
    assert {cell: elite.fitness for cell, elite in search.archive.items()} == expected
    assert min(expected.values()) < 0 < max(expected.values())
    assert all(cell_of(elite.road) == cell for cell, elite in search.archive.items())


def test_an_error_teaches_nothing_and_costs_one_iteration() -> None:
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


def test_a_car_that_got_stuck_in_its_lane_has_failed() -> None:
    """Its fitness is above 0; a road on which the driver came closer to the edge, but drove on, does not replace it."""
    search = DeepHyperion(SearchSettings(population=1, iterations=60, extent=1), np.random.default_rng(3))
    road = search.ask()
    search.tell(1.9, failed=True)
    stuck = search.archive[cell_of(road)]
    assert stuck.failed
    while not search.done:
        search.ask()
        search.tell(1.0)
    assert search.archive[cell_of(road)] == stuck
    again = DeepHyperion(SearchSettings(population=1, iterations=60, extent=1), np.random.default_rng(3))
    again.ask()
    again.tell(0.1)
    replaced = False
    while not again.done and not replaced:
        again.ask()
        again.tell(1.9, failed=True)
        replaced = again.archive[cell_of(road)].failed
    assert replaced
