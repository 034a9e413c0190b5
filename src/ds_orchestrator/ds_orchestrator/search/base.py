"""Common base of all searches: the ask/tell interface, settings, initial population (paper 3.3, algorithm 1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from ds_orchestrator.search.archive import Archive
from ds_orchestrator.search.features import Cell, cell_of
from ds_road import Road, generate


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Hyper-parameters of one search.

    Attributes:
        population: random roads to begin with (paper 4.2.4: 20).
        iterations: mutants after that (paper 4.2.4: 150).
        min_angle: degrees, smallest maximum angle of the first roads (maxitwo: 100).
        max_angle: degrees, largest maximum angle of the first roads (maxitwo: 300).
        extent: m, largest move of a control point (maxitwo: 6).
        maxitwo_compatible: as in maxitwo, one iteration more than configured, mutants whose spline ignores the first
            control point, and turns counted with its constants.
    """

    population: int = 20
    iterations: int = 150
    min_angle: int = 100
    max_angle: int = 300
    extent: int = 6
    maxitwo_compatible: bool = False

    @property
    def budget(self) -> int:
        """Roads that a whole search asks for."""
        return self.population + self.iterations + self.maxitwo_compatible


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
        place = cell if cell is not None else cell_of(road, maxitwo_compatible=self._settings.maxitwo_compatible)
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
