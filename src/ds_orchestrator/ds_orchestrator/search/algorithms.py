# SPDX-License-Identifier: Apache-2.0
"""Searches for tests on which a driver fails (paper 3.3, algorithm 1): settings, archive, and choice of tests."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from ds_base.extension import ExtensionError, is_extension, load_extension
from ds_orchestrator.search.features import Cell, cell_of
from ds_road import MutationError, Road, Side, generate, mutate
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions, ConditionsError, between, share_of
from ds_sim.conditions.text import check_known
from ds_sim.scenario import OfScenario, Scenario

STEP = 0.2
"""Largest mutation of a condition, as a share of its range; chosen: about what 6 m, the largest move of a
control point, are of the 25 m between two of them."""
TRIES = 50
"""Mutants that repeat an earlier test before a random test is drawn instead; chosen: a road has 72 neighbours, so that
many repeats in a row mean that there is hardly a new one."""


@dataclass(frozen=True, kw_only=True)
class SearchedCondition:
    """One condition of a search. Steps and draws are uniform on the condition's scale (`ds_sim.conditions.model`).

    Attributes:
        name: of the condition.
        low: smallest value.
        high: largest value, finite.
        step: largest mutation, as a share of the range.

    Raises:
        ConditionsError: the name is unknown, or the range is none.
    """

    name: str
    low: float
    high: float
    step: float = STEP

    def __post_init__(self) -> None:
        check_known(self.name)
        field = FIELDS[self.name]
        if not (field.low <= self.low < self.high <= field.high and math.isfinite(self.high)):
            raise ConditionsError(
                f"{self.name} is searched from {self.low:g} to {self.high:g}: expected a finite range within "
                f"{field.allowed}"
            )
        if not 0.0 < self.step <= 1.0:
            raise ConditionsError(f"{self.name} has steps of {self.step:g} of its range: expected above 0, at most 1")

    def draw(self, rng: np.random.Generator) -> float:
        """Draw a value of the range."""
        return between(self.name, self.low, self.high, float(rng.random()))

    def mutated(self, value: float, rng: np.random.Generator) -> float:
        """Move a value by at most a step; the ends of the range reflect it."""
        share = share_of(self.name, self.low, self.high, value) + float(rng.uniform(-self.step, self.step))
        share = abs(share)
        return between(self.name, self.low, self.high, 2.0 - share if share > 1.0 else share)


@dataclass(frozen=True)
class ConditionSpace:
    """All conditions that a search varies, beside those that it keeps fixed; varies none by default.

    Raises:
        ConditionsError: a condition is fixed and searched, is searched twice, or the ranges hold values that contradict
            each other.
    """

    searched: Sequence[SearchedCondition] = ()
    fixed: Conditions = DEFAULT

    def __post_init__(self) -> None:
        names = [one.name for one in self.searched]
        for name in names:
            if name in self.fixed.changed:
                raise ConditionsError(f"{name} is fixed and searched: do one of them")
            if names.count(name) > 1:
                raise ConditionsError(f"{name} is searched twice: do it once")
        for end in ("low", "high"):
            replace(self.fixed, **{one.name: getattr(one, end) for one in self.searched})

    def __bool__(self) -> bool:
        return bool(self.searched)

    def draw(self, rng: np.random.Generator) -> Conditions:
        """Draw all searched conditions; draws nothing from the generator if there are none."""
        return replace(self.fixed, **{one.name: one.draw(rng) for one in self.searched})

    def mutated(self, conditions: Conditions, rng: np.random.Generator) -> Conditions:
        """Mutate one of the searched conditions, chosen uniformly."""
        one = self.searched[int(rng.integers(len(self.searched)))]
        return replace(conditions, **{one.name: one.mutated(getattr(conditions, one.name), rng)})


@dataclass(frozen=True, kw_only=True)
class Elite(OfScenario):
    """Scenario of a cell on which the driver failed first, or else the one with the lowest fitness.

    Attributes:
        fitness: smallest lateral distance on it, m.
    """

    scenario: Scenario
    fitness: float
    failed: bool


class Archive(dict[Cell, Elite]):
    """Elite of each cell.

    A candidate with a higher fitness than the elite does not enter:

        >>> from ds_orchestrator.search.algorithms import Archive
        >>> from ds_road import Road
        >>> from ds_sim import Scenario
        >>> one = Scenario(Road([[0, 0], [0, 25], [0, 50], [0, 75]]), seed=1)
        >>> archive = Archive()
        >>> archive.place((1, 10), one, 1.5, failed=False), archive.place((1, 10), one, 1.9, failed=False)
        (True, False)
        >>> archive[1, 10].fitness
        1.5
    """

    def place(self, cell: Cell, scenario: Scenario, fitness: float, *, failed: bool) -> bool:
        """Compete for a cell (paper 3.3): the lower fitness wins, and an elite on which the driver failed stays.

        Args:
            cell: cell of the feature map.
            scenario: the candidate.
            fitness: smallest lateral distance on the candidate, m; below 0 it counts as a failure.
            failed: whether the driver failed, as also a car that stopped in its lane has.

        Returns:
            Whether the candidate is now the elite of the cell.
        """
        failed = failed or fitness < 0.0
        elite = self.get(cell)
        placed = elite is None or (not elite.failed and (failed or fitness < elite.fitness))
        if placed:
            self[cell] = Elite(scenario=scenario, fitness=fitness, failed=failed)
        return placed


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


class Search(ABC):
    """Base class of searches with an ask/tell interface, as in pyribs and Optuna.

    `ask` returns the next road (`ask_test` the next scenario), the caller drives it in any way, and `tell` reports its
    fitness. No road is asked for twice under the same conditions. The search owns no simulator: what it asks for
    depends on its settings, the generator's seed and the reported outcomes alone. `archive` maps each cell of the
    feature map to its elite.

    A search with a synthetic fitness:

        >>> import numpy as np
        >>> from ds_orchestrator.search.algorithms import DeepHyperion
        >>> from ds_orchestrator.search.algorithms import SearchSettings
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

    Every random choice is drawn from `rng`.
    """

    def __init__(self, settings: SearchSettings, rng: np.random.Generator) -> None:
        self._settings, self._rng = settings, rng
        self._angles = np.arange(settings.min_angle, settings.max_angle + 1, 10)
        self._angle_weights = np.ones(len(self._angles))
        self._asked = 0
        self._known: set[tuple[str, Conditions]] = set()
        self._pending: Scenario | None = None
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

    def ask_test(self, seed: int = 0) -> Scenario:
        """Return the next scenario to drive.

        Args:
            seed: seed of the drive, on which no search depends.

        Raises:
            RuntimeError: the outcome of the last test is missing, or the budget is spent.
        """
        if self._pending is not None:
            raise RuntimeError("tell the fitness of the last road before asking for another one")
        if self._asked == self.budget:
            raise RuntimeError("the search is done: its budget is spent")
        self._pending = self._new_test(seed)
        self._known.add(self._pending.unseeded)
        self._asked += 1
        return self._pending

    def _new_test(self, seed: int) -> Scenario:
        """Return a test that is not known yet: a random one where `TRIES` give none. As in maxitwo, any will do."""
        starting = self._asked < self._settings.population or not self.archive
        for _ in range(TRIES):
            self._parent = None
            scenario = Scenario(*(self._random() if starting else self._next()), seed=seed)
            if self._settings.maxitwo_compatible or scenario.unseeded not in self._known:
                return scenario
        self._parent = None
        return Scenario(*self._random(), seed=seed)

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
        placed = self.archive.place(place, test, fitness, failed=failed)
        self._learn(place, placed)

    @abstractmethod
    def _next(self) -> tuple[Road, Conditions]:
        """Return road and conditions of the next test after the initial population; the archive is not empty."""

    def _learn(self, cell: Cell, placed: bool) -> None:
        """Update state that a search keeps in addition to the archive; none by default."""
        return

    def _random(self) -> tuple[Road, Conditions]:
        return self._random_road(), self._settings.conditions.draw(self._rng)

    def _random_road(self) -> Road:
        """Draw a random road; a drawn angle becomes less likely, so that the range is covered (maxitwo)."""
        index = int(self._rng.choice(len(self._angles), p=softmax(self._angle_weights)))
        self._angle_weights[index] = np.clip(self._angle_weights[index] - 0.2, 0.01, 1.0)
        return generate(self._rng, max_angle=int(self._angles[index]), lane=self._settings.lane)


RANKED_SHARE = 0.5
"""Probability with which DeepHyperion-CS selects by rank, otherwise uniformly (DeepHyperion's package)."""
RANK_BIAS = 1.5
"""Probability of the best rank over that of the middle one (DeepHyperion's package; linear ranking)."""


class RandomSearch(Search):
    """Random search, the baseline: draws every test as the other searches draw their initial population."""

    def _next(self) -> tuple[Road, Conditions]:
        return self._random()


class DeepHyperion(Search):
    """DeepHyperion: mutates the elite of a cell that is drawn uniformly (paper 3.3, maxitwo)."""

    def _next(self) -> tuple[Road, Conditions]:
        """Return a mutant; a cell whose elite has no valid mutant is skipped."""
        for cell in self._choices():
            try:
                mutant = self._mutant(self.archive[cell])
            except MutationError:
                continue
            self._parent = cell
            return mutant
        return self._random()

    def _mutant(self, elite: Elite) -> tuple[Road, Conditions]:
        """Mutate a condition of an elite, or else its road."""
        space = self._settings.conditions
        if space and self._rng.random() < self._settings.mutate_conditions:
            return elite.road, space.mutated(elite.conditions, self._rng)
        road = mutate(
            elite.road, self._rng, extent=self._settings.extent, maxitwo_compatible=self._settings.maxitwo_compatible
        )
        return road, elite.conditions

    def _choices(self) -> Iterator[Cell]:
        """Yield the cells of the archive in the order in which to try them."""
        cells = sorted(self.archive)
        for index in self._rng.permutation(len(cells)):
            yield cells[index]


class DeepHyperionCS(DeepHyperion):
    """DeepHyperion that prefers elites whose mutants entered the archive (Zohdinasab et al., TOSEM 2023).

    The contribution score of an elite is the share of its mutants that entered the archive, 1 before the first. With
    probability `RANKED_SHARE` a cell is drawn by the rank of its score (linear ranking), otherwise uniformly.
    """

    def __init__(self, settings: SearchSettings, rng: np.random.Generator) -> None:
        super().__init__(settings, rng)
        self._mutants: dict[Cell, list[bool]] = {}

    def contribution(self, cell: Cell) -> float:
        """Contribution score of the elite of a cell."""
        placed = self._mutants[cell]
        return sum(placed) / len(placed) if placed else 1.0

    def _choices(self) -> Iterator[Cell]:
        if self._rng.random() < RANKED_SHARE:
            ranked = sorted(self.archive, key=lambda cell: (-self.contribution(cell), cell))
            draw = self._rng.random()
            place = (RANK_BIAS - math.sqrt(RANK_BIAS**2 - 4.0 * (RANK_BIAS - 1.0) * draw)) / (2.0 * (RANK_BIAS - 1.0))
            yield ranked[min(int(len(ranked) * place), len(ranked) - 1)]
        yield from super()._choices()

    def _learn(self, cell: Cell, placed: bool) -> None:
        if self._parent is not None:
            self._mutants[self._parent].append(placed)
        if placed:
            self._mutants[cell] = []


SEARCHES: Mapping[str, type[Search]] = {
    "deephyperion": DeepHyperion,
    "deephyperion_cs": DeepHyperionCS,
    "random": RandomSearch,
}
"""Name in a configuration -> search."""


def search_of(name: str) -> type[Search]:
    """Look up a search: a key of `SEARCHES`, or `module:Class`, a subclass of `Search`.

    Raises:
        ds_base.extension.ExtensionError: the name is unknown, or leads to no search.
    """
    if name in SEARCHES:
        return SEARCHES[name]
    if not is_extension(name):
        raise ExtensionError(f"unknown search {name!r}: expected one of {', '.join(SEARCHES)}, or module:Class")
    extension = load_extension(name, type, "search")
    if not issubclass(extension, Search):
        raise ExtensionError(f"search {name} is no subclass of ds_orchestrator.Search")
    return extension
