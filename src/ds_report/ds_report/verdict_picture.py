# SPDX-License-Identifier: Apache-2.0
"""Draws which cells of a feature map fail, are safe, disputed or untested, and which of them the car drove."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from ds_analysis.prediction.verdicts import CellVerdict, Verdicts
from ds_base.palette import BETWEEN, FAIL, INK, PASS, Rgb, ink_on, rgb
from ds_orchestrator.search.features import Cell
from ds_report.heatmap import EMPTY, GRID, Picture, bounds_of_cells, draw_grid, write

FILLS: Mapping[str, Rgb] = {"safe": rgb(PASS), "disputed": rgb(BETWEEN), "fails": rgb(FAIL), "untested": EMPTY}
"""Colours as in the maps of failure probabilities; verdicts are written as words, too."""
_SIZE = 78, 40


def draw_verdicts(verdicts: Verdicts, title: str) -> Picture:
    """Draw the cells over the first two axes; maps of three axes get one panel for each bin of the third.

    A cell shows its verdict, the mean failure rate, and the number of tests; a cell that the car drove has a frame, and
    the number of its drives.

    Args:
        verdicts: with at least one cell.
        title: heading.

    Returns:
        (rows, columns, 3) uint8 RGB.
    """
    panels = []
    for third in sorted({one.cell[2:] for one in verdicts.cells if one.tests}):
        rest = "".join(
            f", {feature.title} {feature.label(bin_)}"
            for feature, bin_ in zip(verdicts.features[2:], third, strict=True)
        )
        panels.append(_panel(verdicts, third, f"{title}{rest}"))
    width = max(panel.shape[1] for panel in panels)
    padded = [np.pad(panel, ((0, 0), (0, width - panel.shape[1]), (0, 0)), constant_values=255) for panel in panels]
    return np.vstack(padded)


def _panel(verdicts: Verdicts, third: Cell, title: str) -> Picture:
    cells = {one.cell[:2]: one for one in verdicts.cells if one.cell[2:] == third}
    titles = title, "failure rate, n: tests; framed: driven by the car"
    bounds = bounds_of_cells(list(cells))
    return draw_grid(titles, verdicts.features, bounds, _SIZE, lambda patch, cell: _draw(patch, cells.get(cell)))


def _draw(patch: Picture, cell: CellVerdict | None) -> None:
    verdict = "untested" if cell is None else cell.verdict
    patch[:] = FILLS[verdict]
    cv2.rectangle(patch, (0, 0), _SIZE, GRID, 1)
    if cell is None or cell.rate is None:
        return
    driven, ink = f", {cell.driven} real" if cell.driven else "", ink_on(FILLS[verdict])
    write(patch, verdict, (6, 16), 0.4, ink=ink)
    write(patch, f"{cell.rate:.2f} n={cell.tests}{driven}", (6, 32), 0.3 if driven else 0.35, ink=ink)
    if cell.driven:
        cv2.rectangle(patch, (2, 2), (_SIZE[0] - 2, _SIZE[1] - 2), rgb(INK), 2)
