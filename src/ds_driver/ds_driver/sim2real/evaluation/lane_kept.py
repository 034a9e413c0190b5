"""Compares the lines found in images with where they are: does a translation bend or drop them?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_driver.sim2real.lane.lane_pairs import FIRST_ROW, HEIGHTS, lane_shape
from ds_driver.sim2real.lane.line_finder import find_lines, lane_borders

NEAR = 0.06
"""Distance from the true line in which a found one is its own, in widths of the image; chosen: a tenth of a lane."""
LANE_LINES = ("yellow", "right")
Truth = dict[str, NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneKept:
    """Agreement of found lines with the truth, over a set of images.

    Attributes:
        overlap: intersection over union of all line pixels, found and true, of the same colour.
        shift: median distance of the lane's lines from where they are, sideways, px.
        shift_95: 95th percentile of it, px.
        found_yellow: share of the rows of the lane's yellow line in which it was found.
        found_white: the same of its white line.
    """

    overlap: float
    shift: float
    shift_95: float
    found_yellow: float
    found_white: float


def lane_kept(images: Sequence[NDArray[np.uint8]], truths: Sequence[Truth]) -> LaneKept:
    """Find the lines in images and compare them with the truth.

    Args:
        images: (rows, columns, 3) uint8 RGB each.
        truths: masks of each image, from `ds_driver.sim2real.evaluation.line_truth`.
    """
    common = either = 0
    shifts: list[float] = []
    rows, found_rows = dict.fromkeys(LANE_LINES, 0), dict.fromkeys(LANE_LINES, 0)
    for image, truth in zip(images, truths, strict=True):
        lines = find_lines(image)
        white = truth["right"] | truth["left"]
        for found, true in ((lines.yellow, truth["yellow"]), (lines.white, white)):
            seen = np.flatnonzero(true.any(axis=1))
            part = slice(seen[0], None) if seen.size else slice(0)
            common += int((found & true)[part].sum())
            either += int((found | true)[part].sum())
        for name, found in zip(LANE_LINES, (lines.yellow, lines.white), strict=True):
            moved, count = _shifts(found, truth[name])
            shifts += moved
            rows[name] += count
            found_rows[name] += len(moved)
    share = {name: found_rows[name] / rows[name] if rows[name] else 0.0 for name in LANE_LINES}
    return LaneKept(
        overlap=common / either if either else 0.0,
        shift=float(np.median(shifts)) if shifts else float(images[0].shape[1]),
        shift_95=float(np.quantile(shifts, 0.95)) if shifts else float(images[0].shape[1]),
        found_yellow=share["yellow"],
        found_white=share["right"],
    )


def lines_of_photographs(photographs: NDArray[np.uint8]) -> dict[str, float]:
    """Measure in how many rows photographs show the lane's lines: real lines are dashed and worn.

    Rows are those from the farthest one in which a line is found down to the car, where a curve through what is found
    is in the picture.

    Args:
        photographs: (n, rows, columns, 3) uint8 RGB, prepared.

    Returns:
        Share of the rows of the `yellow` and of the `white` line; 1 if no photograph shows both.
    """
    height, width = photographs.shape[1:3]
    rows, found_rows = np.zeros(2), np.zeros(2)
    every = np.arange(height)
    for image in photographs:
        lines = find_lines(image)
        borders = lane_borders(lines)
        lanes = lane_shape(borders, width)
        if not np.isfinite(lanes).all():
            continue
        for side, (mask, line) in enumerate(zip((lines.yellow, lines.white), lanes.reshape(2, -1), strict=True)):
            seen = np.flatnonzero(np.isfinite(borders[:, side]) & (every >= FIRST_ROW * height))
            columns = np.interp(every, np.array(HEIGHTS) * height, line) * width
            counted = (every >= seen[0]) & (columns > 0) & (columns < width - 1)
            near = np.abs(np.arange(width) - columns[:, None]) <= NEAR * width
            rows[side] += counted.sum()
            found_rows[side] += (counted & (mask & near).any(axis=1)).sum()
    share = np.divide(found_rows, rows, out=np.ones(2), where=rows > 0)
    return {"yellow": float(share[0]), "white": float(share[1])}


def _shifts(found: NDArray[np.bool_], true: NDArray[np.bool_]) -> tuple[list[float], int]:
    """Distances, px, in the rows where a line is found near its place, and the number of rows that have the line."""
    reach, shifts, rows = NEAR * true.shape[1], [], 0
    for seen, is_true in zip(found, true, strict=True):
        columns = np.flatnonzero(is_true)
        # Lines cut by the side of the image have no middle, and flat ones are not measured sideways.
        if not columns.size or columns[0] == 0 or columns[-1] == true.shape[1] - 1 or np.ptp(columns) > 2 * reach:
            continue
        rows += 1
        middle = (columns[0] + columns[-1]) / 2
        near = np.flatnonzero(seen)
        near = near[np.abs(near - middle) <= reach]
        if near.size:
            shifts.append(abs(float(near.mean()) - middle))
    return shifts, rows
