"""Draws which cells of a feature map fail, are safe, disputed or untested, and which of them the car drove."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.heatmap import COLOURS, EMPTY
from ds_analysis.prediction.verdicts import CellVerdict, Verdicts
from ds_orchestrator.search.features import feature_of

Picture = NDArray[np.uint8]
Rgb = tuple[int, int, int]

FILLS: Mapping[str, Rgb] = {"safe": COLOURS[0], "disputed": COLOURS[1], "fails": COLOURS[2], "untested": EMPTY}
"""Colours as in the maps of failure probabilities; verdicts are written as words, too."""
_CELL_WIDTH, _CELL_HEIGHT = 78, 40
_LEFT, _TOP, _RIGHT, _BOTTOM = 76, 62, 20, 56
_INK: Rgb = (30, 30, 30)
_PALE: Rgb = (250, 250, 250)
_GRID: Rgb = (150, 150, 150)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


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
    thirds = sorted({one.cell[2:] for one in verdicts.cells if one.tests})
    panels = []
    for third in thirds:
        rest = "".join(
            f", {feature_of(name).title} {feature_of(name).label(bin_)}"
            for name, bin_ in zip(verdicts.features[2:], third, strict=True)
        )
        panels.append(_panel(verdicts, [one for one in verdicts.cells if one.cell[2:] == third], f"{title}{rest}"))
    width = max(panel.shape[1] for panel in panels)
    padded = [np.pad(panel, ((0, 0), (0, width - panel.shape[1]), (0, 0)), constant_values=255) for panel in panels]
    return np.vstack(padded)


def _panel(verdicts: Verdicts, cells: Sequence[CellVerdict], title: str) -> Picture:
    across, upwards = (feature_of(name) for name in verdicts.features[:2])
    columns, rows = (range(min(bins), max(bins) + 1) for bins in zip(*(one.cell[:2] for one in cells), strict=True))
    height = _TOP + len(rows) * _CELL_HEIGHT + _BOTTOM
    width = max(_LEFT + len(columns) * _CELL_WIDTH + _RIGHT, 560)
    image = np.full((height, width, 3), 255, np.uint8)
    _write(image, title, (12, 22), 0.55)
    _write(image, "failure rate, n: tests; framed: driven by the car", (12, 44), 0.42)
    by_place = {one.cell[:2]: one for one in cells}
    for a in columns:
        for b in rows:
            left = _LEFT + (a - columns[0]) * _CELL_WIDTH
            top = _TOP + (rows[-1] - b) * _CELL_HEIGHT
            _draw(image, (left, top), by_place.get((a, b)))
    base = _TOP + len(rows) * _CELL_HEIGHT
    for a in columns:
        _write(image, across.label(a), (_LEFT + (a - columns[0]) * _CELL_WIDTH + 24, base + 18), 0.42)
    for b in rows:
        label = upwards.label(b)
        _write(image, label, (_LEFT - 8 - 9 * len(label), _TOP + (rows[-1] - b) * _CELL_HEIGHT + 25), 0.42)
    _write(image, f"across: {across.title}; upwards: {upwards.title}", (12, base + 42), 0.45)
    return image


def _draw(image: Picture, at: tuple[int, int], cell: CellVerdict | None) -> None:
    left, top = at
    verdict = "untested" if cell is None else cell.verdict
    patch = image[top : top + _CELL_HEIGHT, left : left + _CELL_WIDTH]
    patch[:] = FILLS[verdict]
    ink = _PALE if verdict == "fails" else _INK
    if cell is not None and cell.rate is not None:
        _write(image, verdict, (left + 6, top + 16), 0.4, ink)
        driven = f", {cell.driven} real" if cell.driven else ""
        _write(image, f"{cell.rate:.2f} n={cell.tests}{driven}", (left + 6, top + 32), 0.3 if driven else 0.35, ink)
    corner = (left + _CELL_WIDTH - 1, top + _CELL_HEIGHT - 1)
    cv2.rectangle(image, (left, top), corner, _GRID, 1)
    if cell is not None and cell.driven:
        cv2.rectangle(image, (left + 2, top + 2), (corner[0] - 2, corner[1] - 2), _INK, 2)


def _write(image: Picture, text: str, at: tuple[int, int], size: float, ink: Rgb = _INK) -> None:
    cv2.putText(image, text, at, _FONT, size, ink, 1, cv2.LINE_AA)
