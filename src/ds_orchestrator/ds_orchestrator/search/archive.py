"""Archive of a MAP-Elites search: one elite per cell (paper 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

from ds_orchestrator.search.features import Cell
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions


@dataclass(frozen=True, kw_only=True)
class Elite:
    """Test of a cell on which the driver failed first, or else the one with the lowest fitness.

    Attributes:
        road: road of the test.
        fitness: smallest lateral distance on it, m.
        failed: whether the driver failed on it.
        conditions: operating conditions of the test.
    """

    road: Road
    fitness: float
    failed: bool
    conditions: Conditions = DEFAULT


class Archive(dict[Cell, Elite]):
    """Elite of each cell.

    A candidate with a higher fitness than the elite does not enter:

        >>> from ds_orchestrator.search.archive import Archive
        >>> from ds_road import Road
        >>> road = Road([[0, 0], [0, 25], [0, 50], [0, 75]])
        >>> archive = Archive()
        >>> archive.place((1, 10), road, 1.5, failed=False), archive.place((1, 10), road, 1.9, failed=False)
        (True, False)
        >>> archive[1, 10].fitness
        1.5
    """

    def place(self, cell: Cell, road: Road, fitness: float, *, failed: bool, conditions: Conditions = DEFAULT) -> bool:
        """Compete for a cell (paper 3.3): the lower fitness wins, and an elite on which the driver failed stays.

        Args:
            cell: cell of the feature map.
            road: road of the candidate.
            fitness: smallest lateral distance on the candidate, m.
            failed: whether the driver failed; a fitness below 0 always counts as a failure, and a car that stopped in
                its lane failed as well.
            conditions: operating conditions of the candidate.

        Returns:
            Whether the candidate is now the elite of the cell.
        """
        failed = failed or fitness < 0.0
        elite = self.get(cell)
        placed = elite is None or (not elite.failed and (failed or fitness < elite.fitness))
        if placed:
            self[cell] = Elite(road=road, fitness=fitness, failed=failed, conditions=conditions)
        return placed
