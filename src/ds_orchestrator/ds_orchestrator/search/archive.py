"""The archive of a MAP-Elites search: one elite per cell (paper 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

from ds_orchestrator.search.features import Cell
from ds_road import Road


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
