# SPDX-License-Identifier: Apache-2.0
"""Points of the lane's lines in one image, on the floor, each with its colour and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_driver.sim2real.lane_view import YELLOW, find_lines
from ds_recording.floor_camera import FloorCamera

Array = NDArray[np.float64]
WIDEST = 0.2
"""Longest crossing of a line beyond two pixels, lane widths; chosen: tape of a tenth, crossed at 30 degrees."""
BRIGHTER = 25.0
"""Least surplus of a white line over the floor's brighter quarter, grey levels; chosen: worn tape 40, grain 15."""
FARTHEST = 7.0
"""Distance of the farthest points that are used, lane widths; chosen: beyond, a pixel is longer than a dash."""
MOST = 45
"""Points of one colour that are kept; chosen: more are neighbours that tell the same."""
CENTRES = {"yellow": YELLOW, "green": (-1.16, 0.81), "blue": (0.25, -1.39)}
"""Colour of the centre line -> weights of a and b of CIE Lab; chosen: the hues of green and blue paint, 145 and 280
degrees, as long as yellow's. Red and orange are found as yellow."""
PIXEL = 0.7
"""Standard deviation of a point across its line, px; chosen: a mask's edge is known within a pixel on either side."""


@dataclass(frozen=True, slots=True)
class LinePoints:
    """Middles of painted lines in one image; lengths in lane widths."""

    floor: Array  # ahead and left of the car, (n, 2)
    white: NDArray[np.bool_]  # whether a point is white, of an edge, or coloured, of the middle, (n,)
    spread: Array  # derivative of `floor` by column and row times `PIXEL`, (n, 2, 2)

    def __len__(self) -> int:
        return len(self.floor)


def line_pixels(
    image: NDArray[np.uint8], first_row: int, centre: str = "yellow"
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Find where lines are crossed squarely along a row or a column of an image, (rows, columns, 3) uint8 RGB.

    Returns their middles (n, 2) px, ends of the crossing (n, 2, 2) px, whether white (n,); `first_row` is the first
    that can show the floor.
    """
    lines = find_lines(image, CENTRES[centre])
    # Between a white and a coloured line the road itself looks like a ridge, but it is no brighter than elsewhere.
    palest = image.min(axis=2)
    bright = palest > np.quantile(palest[max(first_row, 0) :], 0.75) + BRIGHTER
    parts = []
    for white, mask in ((False, lines.yellow), (True, lines.white & bright)):
        visible = mask.copy()
        visible[: max(first_row, 0)] = False
        across, upright = _runs(visible), _runs(visible.T)
        lengths = [_lengths(visible.shape, across), _lengths(visible.T.shape, upright).T]
        for runs, own, other, turned in (
            (across, lengths[0], lengths[1], False),
            (upright, lengths[1], lengths[0], True),
        ):
            line, begin, end = runs
            inside = (begin > 0) & (end < visible.shape[0 if turned else 1])
            middle = (begin + end - 1) / 2.0
            at = (middle.astype(int), line) if turned else (line, middle.astype(int))
            # Of the two directions, that which crosses the line sooner; a row where both are equal.
            square = inside & ((own[at] < other[at]) if turned else (own[at] <= other[at]))
            one, low, high = line[square].astype(float), begin[square] - 0.5, end[square] - 0.5
            places = [np.stack((one, v) if turned else (v, one), axis=1) for v in (middle[square], low, high)]
            parts.append((places[0], np.stack(places[1:], axis=1), np.full(len(one), white)))
    joined = [np.concatenate([part[i] for part in parts]) for i in range(3)]
    return joined[0], joined[1], joined[2]


def points_on_floor(pixels_of_lines: tuple[Array, Array, NDArray[np.bool_]], camera: FloorCamera) -> LinePoints:
    """Place lines of `line_pixels` on the floor, and leave out what is too wide for a line or too far away.

    The camera's unit of length is a lane width.
    """
    pixels, ends, white = pixels_of_lines
    if not len(pixels):
        return LinePoints(np.zeros((0, 2)), white, np.zeros((0, 2, 2)))
    floor, valid = camera.floor(pixels)
    (low, low_valid), (high, high_valid) = camera.floor(ends[:, 0]), camera.floor(ends[:, 1])
    step = [(camera.floor(pixels + e)[0] - camera.floor(pixels - e)[0]) / 2.0 for e in ((0.3, 0.0), (0.0, 0.3))]
    spread = np.stack(step, axis=2) * (PIXEL / 0.3)
    valid &= low_valid & high_valid & (floor[:, 0] < FARTHEST) & (np.abs(floor[:, 1]) < FARTHEST)
    pixel = np.hypot(*((high - low) / np.maximum(np.abs(ends[:, 1] - ends[:, 0]).sum(axis=1), 1.0)[:, None]).T)
    valid &= np.hypot(*(high - low).T) < WIDEST + 2.0 * pixel
    kept = np.flatnonzero(valid)
    chosen = []
    for colour in (False, True):
        own = kept[white[kept] == colour]
        own = own[np.argsort(floor[own, 0], kind="stable")]
        chosen.append(own[np.linspace(0, len(own) - 1, MOST).round().astype(int)] if len(own) > MOST else own)
    index = np.concatenate(chosen)
    return LinePoints(floor[index], white[index], spread[index])


def _runs(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Line, begin and end of every run of pixels along the last axis."""
    change = np.diff(np.pad(mask.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    line, begin = np.nonzero(change == 1)
    return line, begin, np.nonzero(change == -1)[1]


def _lengths(
    shape: tuple[int, ...], runs: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
) -> NDArray[np.int64]:
    """Length of the run that each pixel belongs to; 0 outside."""
    line, begin, end = runs
    steps = np.zeros((shape[0], shape[1] + 1), np.int64)
    np.add.at(steps, (line, begin), end - begin)
    np.add.at(steps, (line, end), begin - end)
    return np.cumsum(steps, axis=1)[:, :-1]
