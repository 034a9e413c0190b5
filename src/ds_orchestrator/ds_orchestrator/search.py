"""DeepHyperion: MAP-Elites over the features of roads (paper 3.3, algorithm 1). It owns no simulator and no clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from ds_road import MutationError, Road, generate, mutate

Cell = tuple[int, int]
"""Place in a feature map: (turns count, int(100 x curvature)), paper 3.3."""


def cell_of(road: Road) -> Cell:
    """The cell of a road in a feature map."""
    return road.turns_count, road.curvature_bin


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Hyper-parameters of one search.

    Attributes:
        population: random roads to begin with (paper 4.2.4: 20).
        iterations: mutants after that (paper 4.2.4: 150).
        min_angle: degrees, smallest maximum angle of the first roads (maxitwo: 100).
        max_angle: degrees, largest maximum angle of the first roads (maxitwo: 300).
        extent: m, largest move of a control point (maxitwo: 6).
    """

    population: int = 20
    iterations: int = 150
    min_angle: int = 100
    max_angle: int = 300
    extent: int = 6


@dataclass(frozen=True, kw_only=True)
class Elite:
    """The road of a cell on which the driver failed, or else the one with the lowest fitness."""

    road: Road
    fitness: float
    failed: bool


class DeepHyperion:
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
        self.archive: dict[Cell, Elite] = {}

    @property
    def budget(self) -> int:
        """Roads that the whole search asks for."""
        return self._settings.population + self._settings.iterations

    @property
    def done(self) -> bool:
        """True when every road of the budget was asked for and told."""
        return self._asked == self.budget and self._pending is None

    def ask(self) -> Road:
        """The next road to execute: random ones first, then mutants of elites."""
        if self._pending is not None:
            raise RuntimeError("tell the fitness of the last road before asking for another one")
        if self._asked == self.budget:
            raise RuntimeError("the search is done: its budget is spent")
        starting = self._asked < self._settings.population or not self.archive
        self._pending = self._random_road() if starting else self._mutant()
        self._asked += 1
        return self._pending

    def tell(self, fitness: float | None, *, failed: bool = False) -> None:
        """Take in the outcome of the last road.

        Args:
            fitness: in m, or None when its execution was an error.
            failed: whether the driver failed; it always did where the fitness is below 0, but a car that stopped in
                its lane failed as well.
        """
        road = self._pending
        if road is None:
            raise RuntimeError("there is no road to tell about: ask for one first")
        self._pending = None
        if fitness is None:
            return
        cell = cell_of(road)
        elite = self.archive.get(cell)
        # Local competition; an elite that fails already stays (paper 3.3).
        failed = failed or fitness < 0.0
        if elite is None or (not elite.failed and (failed or fitness < elite.fitness)):
            self.archive[cell] = Elite(road=road, fitness=fitness, failed=failed)

    def _random_road(self) -> Road:
        """A random road; an angle that was drawn becomes less likely, so that the range is covered (maxitwo)."""
        index = int(self._rng.choice(len(self._angles), p=softmax(self._angle_weights)))
        self._angle_weights[index] = np.clip(self._angle_weights[index] - 0.2, 0.01, 1.0)
        return generate(self._rng, max_angle=int(self._angles[index]))

    def _mutant(self) -> Road:
        """A mutant of the elite of a uniformly chosen cell; a cell whose elite cannot be mutated is passed over."""
        cells = sorted(self.archive)
        for index in self._rng.permutation(len(cells)):
            try:
                return mutate(self.archive[cells[index]].road, self._rng, extent=self._settings.extent)
            except MutationError:
                continue
        return self._random_road()
