"""Difference of two networks per cell of the feature map, as coloured grids in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import CellComparison, Comparison
    from ds_orchestrator.search.features import Cell

MOST_COLUMNS = 14
"""Columns of a grid; chosen: they fit on a line of 120 characters."""


def difference_grids(comparison: Comparison) -> list[tuple[str, Table]]:
    """Heading and grid of each simulator, of maps of two features; none for others, or for cells that do not fit."""
    from ds_orchestrator.search.features import feature_of

    if len(comparison.features) != 2:
        return []
    across, up = (feature_of(name) for name in comparison.features)
    made = []
    for simulator in dict.fromkeys(one.simulator for one in comparison.cells):
        cells = {one.cell: one for one in comparison.cells if one.simulator == simulator}
        columns = sorted({cell[0] for cell in cells})
        if len(columns) > MOST_COLUMNS:
            continue
        table = Table(caption=f"{across.title} →", box=SIMPLE, pad_edge=False, padding=(0, 1))
        table.add_column(f"{up.title} ↑", justify="right", no_wrap=True)
        for column in columns:
            table.add_column(across.label(column), justify="center", min_width=7, no_wrap=True)
        for row in sorted({cell[1] for cell in cells}, reverse=True):
            table.add_row(up.label(row), *(_box(cells, (column, row)) for column in columns))
        made.append((f"{simulator}: tests that newly fail (+) and that are fixed (-), of all", table))
    return made


def change_text(one: CellComparison) -> str:
    """Changes of a cell in a few characters, such as `+2 -1/4`."""
    counts = one.counts
    changes: Sequence[str] = [
        *([f"+{counts.newly_fail}"] if counts.newly_fail else []),
        *([f"-{counts.fixed}"] if counts.fixed else []),
    ]
    return f"{' '.join(changes) or '0'}/{counts.tests}"


def _box(cells: dict[Cell, CellComparison], cell: Cell) -> Text:
    one = cells.get(cell)
    if one is None:
        return Text("·", style="dim")
    difference = one.counts.difference or 0.0
    style = "bold white on rgb(198,40,40)" if difference > 0 else "bold white on rgb(46,125,50)"
    return Text(change_text(one), style=style if difference else "")
