"""Searches for roads on which a driver fails (paper 3.3, algorithm 1), all with one interface: ask, execute, tell.

They own no simulator and no clock. What a search asks for depends on its settings, its generator's seed and what it was
told, on nothing else: told the same again, it goes the same way, which is how a stopped campaign goes on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from ds_orchestrator.search.base import Search, SearchSettings
from ds_orchestrator.search.features import Cell
from ds_road import MutationError, Road, mutate

RANKED_SHARE = 0.5
"""Probability with which DeepHyperion-CS selects by rank, otherwise uniformly (DeepHyperion's package)."""
RANK_BIAS = 1.5
"""How much likelier the best rank is chosen than the middle one (DeepHyperion's package; linear ranking)."""


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
                    maxitwo_compatible=self._settings.maxitwo_compatible,
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
