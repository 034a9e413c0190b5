"""Searches for roads on which a driver fails (paper 3.3, algorithm 1), all with one interface: ask, execute, tell.

They own no simulator and no clock. What a search asks for depends on its settings, its generator's seed and what it was
told, on nothing else: told the same again, it goes the same way, which is how a stopped campaign goes on.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from ds_orchestrator.features import Cell, cell_of
from ds_road import MutationError, Road, generate, mutate

RANKED_SHARE = 0.5
"""Probability with which DeepHyperion-CS selects by rank, otherwise uniformly (DeepHyperion's package)."""
RANK_BIAS = 1.5
"""How much likelier the best rank is chosen than the middle one (DeepHyperion's package; linear ranking)."""


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Hyper-parameters of one search.

    Attributes:
        population: random roads to begin with (paper 4.2.4: 20).
        iterations: mutants after that (paper 4.2.4: 150).
        min_angle: degrees, smallest maximum angle of the first roads (maxitwo: 100).
        max_angle: degrees, largest maximum angle of the first roads (maxitwo: 300).
        extent: m, largest move of a control point (maxitwo: 6).
        published: as in maxitwo, one iteration more than said, mutants whose spline ignores the first control point,
            and turns counted with its constants.
    """

    population: int = 20
    iterations: int = 150
    min_angle: int = 100
    max_angle: int = 300
    extent: int = 6
    published: bool = False

    @property
    def budget(self) -> int:
        """Roads that a whole search asks for."""
        return self.population + self.iterations + self.published


@dataclass(frozen=True, kw_only=True)
class Elite:
    """The road of a cell on which the driver failed, or else the one with the lowest fitness."""

    road: Road
    fitness: float
    failed: bool


class Archive(dict[Cell, Elite]):
    """The elite of each cell."""

    def place(self, cell: Cell, road: Road, fitness: float, *, failed: bool) -> bool:
        """Local competition (paper 3.3): the lower fitness wins, and an elite that fails already stays.

        Args:
            cell: where the road belongs.
            road: the candidate.
            fitness: in m.
            failed: whether the driver failed; it always did where the fitness is below 0, but a car that stopped in
                its lane failed as well.

        Returns:
            Whether the candidate is the cell's elite now.
        """
        failed = failed or fitness < 0.0
        elite = self.get(cell)
        placed = elite is None or (not elite.failed and (failed or fitness < elite.fitness))
        if placed:
            self[cell] = Elite(road=road, fitness=fitness, failed=failed)
        return placed


class Search(ABC):
    """`ask` for a road, execute it, `tell` its fitness; `archive` holds the elite of each cell.

    Args:
        settings: hyper-parameters.
        rng: source of every random choice.
    """

    def __init__(self, settings: SearchSettings, rng: np.random.Generator) -> None:
        self._settings = settings
        self._rng = rng
        self._angles = np.arange(settings.min_angle, settings.max_angle + 1, 10)
        self._angle_weights = np.ones(len(self._angles))
        self._asked = 0
        self._pending: Road | None = None
        self._parent: Cell | None = None
        self.archive = Archive()

    @property
    def budget(self) -> int:
        """Roads that the whole search asks for."""
        return self._settings.budget

    @property
    def done(self) -> bool:
        """True when every road of the budget was asked for and told."""
        return self._asked == self.budget and self._pending is None

    def ask(self) -> Road:
        """The next road to execute."""
        if self._pending is not None:
            raise RuntimeError("tell the fitness of the last road before asking for another one")
        if self._asked == self.budget:
            raise RuntimeError("the search is done: its budget is spent")
        self._parent = None
        starting = self._asked < self._settings.population or not self.archive
        self._pending = self._random_road() if starting else self._next_road()
        self._asked += 1
        return self._pending

    def tell(self, fitness: float | None, *, failed: bool = False, cell: Cell | None = None) -> None:
        """Take in the outcome of the last road.

        Args:
            fitness: in m, or None when its execution was an error: nothing was learnt then.
            failed: whether the driver failed; see `Archive.place`.
            cell: where the road belongs; by its turns count and curvature if left out.
        """
        road = self._pending
        if road is None:
            raise RuntimeError("there is no road to tell about: ask for one first")
        self._pending = None
        if fitness is None:
            return
        place = cell if cell is not None else cell_of(road, published=self._settings.published)
        assert place is not None
        placed = self.archive.place(place, road, fitness, failed=failed)
        self._learn(place, placed)

    @abstractmethod
    def _next_road(self) -> Road:
        """The next road once the initial population is there, and something in the archive."""

    def _learn(self, cell: Cell, placed: bool) -> None:
        """What else a search remembers of an outcome; most remember nothing."""
        return

    def _random_road(self) -> Road:
        """A random road; an angle that was drawn becomes less likely, so that the range is covered (maxitwo)."""
        index = int(self._rng.choice(len(self._angles), p=softmax(self._angle_weights)))
        self._angle_weights[index] = np.clip(self._angle_weights[index] - 0.2, 0.01, 1.0)
        return generate(self._rng, max_angle=int(self._angles[index]))


class RandomSearch(Search):
    """The baseline: every road is drawn like those of the other searches' initial population."""

    def _next_road(self) -> Road:
        return self._random_road()


class DeepHyperion(Search):
    """Mutants of elites, each from a uniformly chosen cell (paper 3.3; maxitwo chooses among cells as well)."""

    def _next_road(self) -> Road:
        """A mutant; a cell whose elite cannot be mutated is passed over."""
        for cell in self._choices():
            try:
                mutant = mutate(
                    self.archive[cell].road,
                    self._rng,
                    extent=self._settings.extent,
                    published=self._settings.published,
                )
            except MutationError:
                continue
            self._parent = cell
            return mutant
        return self._random_road()

    def _choices(self) -> Iterator[Cell]:
        """The cells of the archive in the order in which to try them."""
        cells = sorted(self.archive)
        for index in self._rng.permutation(len(cells)):
            yield cells[index]


class DeepHyperionCS(DeepHyperion):
    """DeepHyperion that prefers elites whose mutants found a place before (Zohdinasab et al., TOSEM 2023).

    An elite's contribution score is the share of its mutants that were placed, 1 before it has any. With probability
    `RANKED_SHARE` a cell is drawn by the rank of its score (linear ranking), otherwise uniformly.
    """

    def __init__(self, settings: SearchSettings, rng: np.random.Generator) -> None:
        super().__init__(settings, rng)
        self._mutants: dict[Cell, list[bool]] = {}

    def contribution(self, cell: Cell) -> float:
        """Contribution score of a cell's elite."""
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
"""Every search by its name in a configuration."""
