"""Search algorithms for tests on which a driver fails (paper 3.3, algorithm 1); see `Search` for their interface."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from ds_orchestrator.search.archive import Elite
from ds_orchestrator.search.base import Candidate, Search, SearchSettings
from ds_orchestrator.search.features import Cell
from ds_road import MutationError, mutate
from ds_sim.extension import ExtensionError, is_extension, load_extension

RANKED_SHARE = 0.5
"""Probability with which DeepHyperion-CS selects by rank, otherwise uniformly (DeepHyperion's package)."""
RANK_BIAS = 1.5
"""Probability of the best rank over that of the middle one (DeepHyperion's package; linear ranking)."""


class RandomSearch(Search):
    """Random search, the baseline: draws every test as the other searches draw their initial population."""

    def _next(self) -> Candidate:
        return self._random()


class DeepHyperion(Search):
    """DeepHyperion: mutates the elite of a cell that is drawn uniformly (paper 3.3, maxitwo)."""

    def _next(self) -> Candidate:
        """Return a mutant; a cell whose elite has no valid mutant is skipped."""
        for cell in self._choices():
            try:
                mutant = self._mutant(self.archive[cell])
            except MutationError:
                continue
            self._parent = cell
            return mutant
        return self._random()

    def _mutant(self, elite: Elite) -> Candidate:
        """Mutate a condition of an elite, or else its road."""
        space = self._settings.conditions
        if space and self._rng.random() < self._settings.mutate_conditions:
            return Candidate(elite.road, space.mutated(elite.conditions, self._rng))
        road = mutate(
            elite.road,
            self._rng,
            extent=self._settings.extent,
            maxitwo_compatible=self._settings.maxitwo_compatible,
        )
        return Candidate(road, elite.conditions)

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
        ds_sim.extension.ExtensionError: the name is unknown, or leads to no search.
    """
    if name in SEARCHES:
        return SEARCHES[name]
    if not is_extension(name):
        raise ExtensionError(f"unknown search {name!r}: expected one of {', '.join(SEARCHES)}, or module:Class")
    found = load_extension(name, type, "search")
    if not issubclass(found, Search):
        raise ExtensionError(f"search {name} is no subclass of ds_orchestrator.Search")
    return found
