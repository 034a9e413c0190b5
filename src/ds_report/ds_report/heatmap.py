# SPDX-License-Identifier: Apache-2.0
"""Draws feature maps in the style of the paper's figures (4.4.2), and verdicts about their cells."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_analysis.prediction.verdicts import CellVerdict, Verdicts
from ds_base.folder_files import write_whole
from ds_base.palette import BETWEEN, FAIL, INK, PASS, Rgb, colour_of_share, ink_on, rgb
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId, compared_ids, slices_of
from ds_orchestrator.search.features import Cell, Feature
from ds_sim.camera.encodings import png
from ds_sim.registry import label_of

Picture = NDArray[np.uint8]
Bounds = tuple[range, range]
"""Bins that a picture shows: of the first feature from left to right, of the second from top to bottom."""
Value = Literal["probability", "quality_loss"]
_FONT = cv2.FONT_HERSHEY_SIMPLEX

VALUE_TITLES: dict[Value, str] = {"probability": "failure probability", "quality_loss": "lack of driving quality"}
_FILE_ENDINGS: dict[Value, str] = {"probability": "probability", "quality_loss": "quality"}
"""End of the PNG files' names; the same as in earlier versions."""
EMPTY: Rgb = (240, 240, 240)
_HATCH: Rgb = (205, 205, 205)
_INK = rgb(INK)
_GRID: Rgb = (150, 150, 150)
_FILLS: Mapping[str, Rgb] = {"safe": rgb(PASS), "disputed": rgb(BETWEEN), "fails": rgb(FAIL), "untested": EMPTY}
_CELL = _CELL_WIDTH, _CELL_HEIGHT = 60, 34
_VERDICT_CELL = 78, 40
_LEFT, _TOP, _RIGHT, _BOTTOM = 72, 66, 78, 52
_BAR_WIDTH, _BAR_HEIGHT = 16, 160


def bounds_of(maps: Iterable[FeatureMap]) -> Bounds:
    """Compute the smallest bounds with every filled cell of all maps, so that pictures are comparable cell by cell."""
    return _bounds_of_cells([cell for one in maps for cell in (*one.cells, *one.excluded)])


def _bounds_of_cells(cells: Sequence[Cell]) -> Bounds:
    across, upwards = ([cell[axis] for cell in cells] or [0] for axis in (0, 1))
    return range(min(across), max(across) + 1), range(max(upwards), min(upwards) - 1, -1)


def draw_map(feature_map: FeatureMap, value: Value, *, bounds: Bounds) -> Picture:
    """Draw one value of a feature map of two features, as (rows, columns, 3) uint8 RGB.

    Filled cells show their value, their number of tests, and as in `-2` how many the gates exclude; others are hatched.
    Maps with the same bounds can be compared cell by cell.
    """
    excluded = sum(feature_map.excluded.values())
    titles = (feature_map.title, VALUE_TITLES[value] + (f"; -n: excluded, {excluded} in all" if excluded else ""))

    def draw(patch: Picture, cell: Cell) -> None:
        _draw_cell(patch, feature_map.cells.get(cell), value, feature_map.excluded.get(cell, 0))

    image = _draw_grid(titles, feature_map.features, bounds, _CELL, draw)
    _draw_colour_bar(image, (_LEFT + _CELL_WIDTH * len(bounds[0]) + 18, _TOP + 8))
    return image


def draw_verdicts(verdicts: Verdicts, title: str) -> Picture:
    """Draw at least one cell over two axes, a panel for each bin of a third, as (rows, columns, 3) uint8 RGB.

    A cell shows its verdict, mean failure rate and tests; one that the car drove has a frame, and the number of drives.
    """
    panels = []
    for rest in sorted({one.cell[2:] for one in verdicts.cells if one.tests}):
        cells = {one.cell[:2]: one for one in verdicts.cells if one.cell[2:] == rest}
        further = zip(verdicts.features[2:], rest, strict=True)
        heading = ", ".join([title, *(f"{feature.title} {feature.label(bin_)}" for feature, bin_ in further)])
        titles = heading, "failure rate, n: tests; framed: driven by the car"

        def draw(patch: Picture, cell: Cell, cells: Mapping[Cell, CellVerdict] = cells) -> None:
            _draw_verdict(patch, cells.get(cell))

        panels.append(_draw_grid(titles, verdicts.features, _bounds_of_cells(list(cells)), _VERDICT_CELL, draw))
    return _stacked(panels)


def _draw_grid(
    titles: tuple[str, str],
    features: Sequence[Feature],
    bounds: Bounds,
    size: tuple[int, int],
    draw: Callable[[Picture, Cell], None],
) -> Picture:
    """Draw titles and cells of a width and height over two features; `draw` gets a cell's pixels, and the cell."""
    (columns, rows), (wide, high) = bounds, size
    grid_width, grid_height = wide * len(columns), high * len(rows)
    title_width = max(_text_width(text, scale) for text, scale in zip(titles, (0.6, 0.5), strict=True))
    width = max(_LEFT + grid_width + _RIGHT, title_width + 24)
    image = np.full((_TOP + max(grid_height, _BAR_HEIGHT + 40) + _BOTTOM, width, 3), 255, np.uint8)
    _write(image, titles[0], (12, 24), 0.6, thickness=2)
    _write(image, titles[1], (12, 46), 0.5)
    across, upwards = features[:2]
    for column, a in enumerate(columns):
        for row, b in enumerate(rows):
            left, top = _LEFT + column * wide, _TOP + row * high
            draw(image[top : top + high + 1, left : left + wide + 1], (a, b))
        middle = _LEFT + column * wide + wide // 2
        _write(image, across.label(a), (middle, _TOP + grid_height + 18), 0.45, anchor="middle")
    for row, b in enumerate(rows):
        baseline = _TOP + row * high + high // 2 + 5
        _write(image, upwards.label(b), (_LEFT - 8, baseline), 0.42, anchor="end")
    _write(image, across.title, (_LEFT + grid_width // 2, _TOP + grid_height + 40), 0.45, anchor="middle")
    _write_upwards(image, upwards.title, (8, _TOP + grid_height // 2))
    return image


def write_maps(maps: Mapping[MapId, FeatureMap], folder: Path) -> None:
    """Write every map of a campaign as `<name>_probability.png` and `<name>_quality.png`, and `overview.png`.

    The overview has siblings' unions, merge and twin side by side. All pictures share the same bounds.
    """
    bounds = bounds_of(maps.values())
    for map_id, feature_map in maps.items():
        for value, ending in _FILE_ENDINGS.items():
            parts = [draw_map(part, value, bounds=bounds) for part in slices_of(feature_map)]
            write_whole(folder / f"{label_of(map_id.name)}_{ending}.png", png(np.hstack(parts)))
    compared = [maps[map_id] for map_id in compared_ids(maps)]
    if compared and len(compared[0].features) == 2:
        rows = [np.hstack([draw_map(m, value, bounds=bounds) for m in compared]) for value in VALUE_TITLES]
        write_whole(folder / "overview.png", png(_stacked(rows)))


def _stacked(pictures: Sequence[Picture]) -> Picture:
    """Put pictures below each other, on white."""
    width = max(picture.shape[1] for picture in pictures)
    return np.vstack(
        [np.pad(one, ((0, 0), (0, width - one.shape[1]), (0, 0)), constant_values=255) for one in pictures]
    )


def _draw_cell(patch: Picture, cell: MapCell | None, value: Value, excluded: int) -> None:
    """Draw a coloured cell with its numbers, or a hatched one if it is empty."""
    middle = _CELL_WIDTH // 2
    apart = f"-{excluded}" if excluded else ""
    inside = patch[:_CELL_HEIGHT, :_CELL_WIDTH]
    if cell is None:
        _hatch(inside, 10)
        _write(patch, apart, (middle, 29), 0.33, anchor="middle")
    else:
        number = float(getattr(cell, value))
        colour = colour_of_share(number)
        ink = ink_on(colour)
        inside[:] = colour
        _write(patch, f"{number:.2f}", (middle, 17), 0.5, ink=ink, anchor="middle")
        _write(patch, f"n={cell.tests} {apart}".rstrip(), (middle, 29), 0.33, ink=ink, anchor="middle")
    cv2.rectangle(patch, (0, 0), _CELL, _GRID, 1)


def _hatch(patch: Picture, apart: int) -> None:
    patch[:] = EMPTY
    height, width = patch.shape[:2]
    for offset in range(-height, width, apart):
        cv2.line(patch, (offset, height), (offset + height, 0), _HATCH, 1, cv2.LINE_AA)


def _draw_verdict(patch: Picture, cell: CellVerdict | None) -> None:
    fill = _FILLS["untested" if cell is None else cell.verdict]
    patch[:] = fill
    cv2.rectangle(patch, (0, 0), _VERDICT_CELL, _GRID, 1)
    if cell is None or cell.rate is None:
        return
    driven, ink = f", {cell.driven} real" if cell.driven else "", ink_on(fill)
    _write(patch, cell.verdict, (6, 16), 0.4, ink=ink)
    _write(patch, f"{cell.rate:.2f} n={cell.tests}{driven}", (6, 32), 0.3 if driven else 0.35, ink=ink)
    if cell.driven:
        cv2.rectangle(patch, (2, 2), (_VERDICT_CELL[0] - 2, _VERDICT_CELL[1] - 2), _INK, 2)


def _draw_colour_bar(image: Picture, corner: tuple[int, int]) -> None:
    """Draw the colours from 1 at the top to 0 at the bottom, and a sample of an empty cell."""
    left, top = corner
    for row in range(_BAR_HEIGHT):
        image[top + row, left : left + _BAR_WIDTH] = colour_of_share(1.0 - row / (_BAR_HEIGHT - 1))
    cv2.rectangle(image, (left, top), (left + _BAR_WIDTH, top + _BAR_HEIGHT), _GRID, 1)
    for number in (0.0, 0.5, 1.0):
        baseline = top + round((1.0 - number) * _BAR_HEIGHT) + 4
        _write(image, f"{number:g}", (left + _BAR_WIDTH + 5, baseline), 0.4)
    patch = image[top + _BAR_HEIGHT + 10 :, left:][:_BAR_WIDTH, :_BAR_WIDTH]
    _hatch(patch, 8)
    cv2.rectangle(patch, (0, 0), (_BAR_WIDTH - 1, _BAR_WIDTH - 1), _GRID, 1)
    _write(image, "no", (left + _BAR_WIDTH + 5, top + _BAR_HEIGHT + 18), 0.33)
    _write(image, "test", (left + _BAR_WIDTH + 5, top + _BAR_HEIGHT + 28), 0.33)


def _write_upwards(image: Picture, text: str, at: tuple[int, int]) -> None:
    """Write text rotated by 90 degrees, centred beside a pixel."""
    strip = np.full((18, _text_width(text, 0.45) + 4, 3), 255, np.uint8)
    _write(strip, text, (2, 13), 0.45)
    turned = cv2.rotate(strip, cv2.ROTATE_90_COUNTERCLOCKWISE)
    top = min(max(at[1] - turned.shape[0] // 2, 0), image.shape[0] - turned.shape[0])
    image[top : top + turned.shape[0], at[0] : at[0] + turned.shape[1]] = turned


def _write(
    image: Picture,
    text: str,
    at: tuple[int, int],
    size: float,
    *,
    ink: Rgb = _INK,
    anchor: Literal["start", "middle", "end"] = "start",
    thickness: int = 1,
) -> None:
    """Write text with its start, middle or end at a pixel of the baseline."""
    width = _text_width(text, size, thickness)
    left = at[0] - {"start": 0, "middle": width // 2, "end": width}[anchor]
    cv2.putText(image, text, (left, at[1]), _FONT, size, ink, thickness, cv2.LINE_AA)


def _text_width(text: str, size: float, thickness: int = 2) -> int:
    """Width of a text, pixels."""
    return int(cv2.getTextSize(text, _FONT, size, thickness)[0][0])
