# SPDX-License-Identifier: Apache-2.0
"""Reads tracks of CSV files: those of RoboRacer and of `ds recording locate`, race lines, plain lines of x and y.

Columns are separated by commas, semicolons, tabs or spaces. Names stand in a first line, with or without `#`; without
names, the first two columns are x and y, in metres, or of three with a constant second one the first and the third.
"""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from ds_road.road import RoadError, abbreviated

NAMES = {
    "x": ("x", "x_m", "pos_x", "x[m]"),
    "y": ("y", "y_m", "pos_y", "y[m]"),
    "right": ("w_tr_right_m", "width_right", "w_right", "right_width"),
    "left": ("w_tr_left_m", "width_left", "w_left", "left_width"),
}
MOST_ROWS = 200_000


def read_track(content: bytes) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Read a track; a `RoadError` names the line of the file.

    Returns:
        Centre line in driving order, (n, 2), and distances from it to the right and to the left border, (n, 2), m; None
        if the file has no widths.
    """
    try:
        lines = content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise RoadError("no text: expected a track of lines x,y") from None
    names: list[str] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        cells = _cells(line.strip().lstrip("#"))
        if not cells:
            continue
        if line.lstrip().startswith("#") or (not rows and not any(map(_is_number, cells))):
            names = names if rows else [cell.lower() for cell in cells]
            continue
        if not all(map(_is_number, cells)) or (rows and len(cells) != len(rows[0])):
            raise RoadError(f"line {number} is {abbreviated(line.strip())}, expected numbers as in the lines before")
        rows.append([float(cell) for cell in cells])
        if len(rows) > MOST_ROWS:
            raise RoadError(f"more than {MOST_ROWS} lines: divide the track")
    if len(rows) < 2:
        raise RoadError("not a track: expected at least two lines x,y, separated by commas, semicolons or spaces")
    table = np.array(rows)
    columns = {
        key: next((names.index(name) for name in aliases if name in names), None) for key, aliases in NAMES.items()
    }
    if len(names) != table.shape[1]:
        if len(names) > table.shape[1] and columns["x"] is not None and columns["y"] is not None:
            raise RoadError(f"{len(names)} columns have names, but lines have {table.shape[1]} numbers: add the others")
        columns = dict.fromkeys(NAMES)  # a remark, not names
    x, y = columns["x"], columns["y"]
    if x is None or y is None:
        if any(columns.values()) or len(names) == table.shape[1] or table.shape[1] < 2:
            raise RoadError(f"columns {', '.join(names)[:60] or 'without names'}: expected x and y among them")
        x, y = 0, 1
        if table.shape[1] == 3 and not np.ptp(table[:, 1]) and np.ptp(table[:, 2]):
            y = 2  # Unity's heights, as in waypoints of the Donkey simulator
    if not np.isfinite(table[:, [x, y]]).all():
        row = int(np.flatnonzero(~np.isfinite(table[:, [x, y]]).all(axis=1))[0])
        raise RoadError(f"row {row + 1} of the track has no finite x and y: correct or delete it")
    right, left = columns["right"], columns["left"]
    if right is None or left is None:
        return table[:, [x, y]], None
    return table[:, [x, y]], table[:, [right, left]]


def _cells(line: str) -> list[str]:
    for separator in (";", ",", "\t"):
        if separator in line:
            cells = [cell.strip() for cell in line.rstrip(separator).split(separator)]
            return cells if separator == "," else [cell.replace(",", ".") for cell in cells]  # decimal commas
    return re.split(r"\s+", line.strip()) if line.strip() else []


def _is_number(text: str) -> bool:
    try:
        return not math.isinf(float(text))
    except ValueError:
        return False
