"""Common base of all searches: the ask/tell interface, settings, initial population (paper 3.3, algorithm 1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from ds_orchestrator.search.archive import Archive
from ds_orchestrator.search.condition_space import ConditionSpace
from ds_orchestrator.search.features import Cell, cell_of
from ds_road import Road, Side, generate
from ds_sim.conditions.model import DEFAULT, Conditions


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Hyper-parameters of one search.

    Attributes:
        population: random roads at the start (paper 4.2.4: 20).
        iterations: mutants after those (paper 4.2.4: 150).
        min_angle: smallest maximum angle of the random roads, degrees (maxitwo: 100).
        max_angle: largest maximum angle of the random roads, degrees (maxitwo: 300).
        extent: largest displacement of a control point, m (maxitwo: 6).
        maxitwo_compatible: behave as maxitwo does: one iteration more than configured, mutants whose spline ignores
            the first control point, and turns counted with its constants.
        lane: lane in which the roads are driven.
        conditions: operating conditions to search, and those that are fixed; by default roads alone are searched, as in
            the paper, with the same random numbers.
        mutate_conditions: probability with which a mutation changes a condition, and not the road.
    """

    population: int = 20
    iterations: int = 150
    min_angle: int = 100
    max_angle: int = 300
    extent: int = 6
    maxitwo_compatible: bool = False
    lane: Side = "right"
    conditions: ConditionSpace = ConditionSpace()
    mutate_conditions: float = 0.5

    @property
    def budget(self) -> int:
        """Number of roads that a whole search asks for."""
        return self.population + self.iterations + self.maxitwo_compatible


@dataclass(frozen=True)
class Candidate:
    """Test that a search asks for.

    Attributes:
        road: road to drive.
        conditions: operating conditions to drive it under.
    """

    road: Road
    conditions: Conditions = DEFAULT


class Search(ABC):
    """Base class of searches with an ask/tell interface, as in pyribs and Optuna.

    `ask` returns the next road (`ask_test` the next road with its conditions), the caller drives it in any way, and
    `tell` reports its fitness. The search owns no simulator: what it asks for depends on its settings, the generator's
    seed and the reported outcomes alone. `archive` maps each cell of the feature map to its elite.

    A search with a synthetic fitness:

        >>> import numpy as np
        >>> from ds_orchestrator.search.algorithms import DeepHyperion
        >>> from ds_orchestrator.search.base import SearchSettings
        >>> search = DeepHyperion(SearchSettings(population=3, iterations=5), np.random.default_rng(1))
        >>> while not search.done:
        ...     road = search.ask()
        ...     search.tell(2.0 - 10.0 * road.curvature)
        >>> search.budget
        8
        >>> worst = min(search.archive.values(), key=lambda elite: elite.fitness)
        >>> worst.fitness == 2.0 - 10.0 * worst.road.curvature
        True

    Tell the same outcomes to a new search with the same seed, and it asks for the same roads: a stopped campaign
    resumes in this way.

    Args:
        settings: hyper-parameters.
        rng: generator of every random choice.
    """

    def __init__(self, settings: SearchSettings, rng: np.random.Generator) -> None:
        self._settings = settings
        self._rng = rng
        self._angles = np.arange(settings.min_angle, settings.max_angle + 1, 10)
        self._angle_weights = np.ones(len(self._angles))
        self._asked = 0
        self._pending: Candidate | None = None
        self._parent: Cell | None = None
        self.archive = Archive()

    @property
    def budget(self) -> int:
        """Number of roads that the whole search asks for."""
        return self._settings.budget

    @property
    def done(self) -> bool:
        """Whether the budget is spent and the last outcome is reported."""
        return self._asked == self.budget and self._pending is None

    def ask(self) -> Road:
        """Return the next road to drive; `ask_test` does it for a search of conditions, too.

        Raises:
            RuntimeError: the outcome of the last road is missing, the budget is spent, or conditions are searched.
        """
        if self._settings.conditions:
            raise RuntimeError("this search has conditions, too: ask for a test, not for a road")
        return self.ask_test().road

    def ask_test(self) -> Candidate:
        """Return the next test to drive: a road, and operating conditions.

        Raises:
            RuntimeError: the outcome of the last test is missing, or the budget is spent.
        """
        if self._pending is not None:
            raise RuntimeError("tell the fitness of the last road before asking for another one")
        if self._asked == self.budget:
            raise RuntimeError("the search is done: its budget is spent")
        self._parent = None
        starting = self._asked < self._settings.population or not self.archive
        self._pending = self._random() if starting else self._next()
        self._asked += 1
        return self._pending

    def tell(self, fitness: float | None, *, failed: bool = False, cell: Cell | None = None) -> None:
        """Report the outcome of the last test.

        Args:
            fitness: smallest lateral distance, m; None if the execution ended in an error.
            failed: whether the driver failed; see `Archive.place`.
            cell: cell of the feature map; computed from turns count and curvature if None.

        Raises:
            RuntimeError: no road was asked for.
        """
        test = self._pending
        if test is None:
            raise RuntimeError("there is no road to tell about: ask for one first")
        self._pending = None
        if fitness is None:
            return
        place = cell if cell is not None else cell_of(test.road, maxitwo_compatible=self._settings.maxitwo_compatible)
        assert place is not None
        placed = self.archive.place(place, test.road, fitness, failed=failed, conditions=test.conditions)
        self._learn(place, placed)

    @abstractmethod
    def _next(self) -> Candidate:
        """Return the next test after the initial population; the archive is not empty."""

    def _learn(self, cell: Cell, placed: bool) -> None:
        """Update state that a search keeps in addition to the archive; none by default."""
        return

    def _random(self) -> Candidate:
        """Draw a random test."""
        return Candidate(self._random_road(), self._settings.conditions.draw(self._rng))

    def _random_road(self) -> Road:
        """Draw a random road; a drawn angle becomes less likely, so that the range is covered (maxitwo)."""
        index = int(self._rng.choice(len(self._angles), p=softmax(self._angle_weights)))
        self._angle_weights[index] = np.clip(self._angle_weights[index] - 0.2, 0.01, 1.0)
        return generate(self._rng, max_angle=int(self._angles[index]), lane=self._settings.lane)
