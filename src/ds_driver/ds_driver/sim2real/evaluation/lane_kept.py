"""Compares the lines found in images with where they are, projected exactly: does a translation bend or drop them?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_driver.sim2real.generator import Window
from ds_driver.sim2real.lane_pairs import FIRST_ROW, HEIGHTS, lane_shape
from ds_driver.sim2real.lane_view import find_lines, lane_borders
from ds_road import Road
from ds_road.geometry import arc_lengths
from ds_sim.camera.lens import NEAREST, project
from ds_sim.camera.spec import CameraSpec
from ds_sim.simulator import VehicleState

LINES = ("yellow", "right", "left")
"""Centre line, and the white edges to the right and left of the driven direction."""
FARTHEST = 20.0
"""Distance up to which lines count, m; chosen: beyond it they are thinner than half a pixel of a small generator."""
STEP = 0.2
"""Length of a piece of a line, m; chosen: its sagitta in the sharpest bend is below a millimetre."""
LEAD_IN, LEAD_OUT = 10.0, 40.0
"""Straight road that simulators draw before the start and beyond the end, m (`ds_sim.camera.ground`)."""
SCALE = 4
"""Pixels of the drawing per pixel of the camera; chosen: half a pixel of a small generator is then 4 wide."""
NEAR = 0.06
"""Distance from the true line in which a found one is its own, in widths of the image; chosen: a tenth of a lane."""
LANE_LINES = ("yellow", "right")
Truth = dict[str, NDArray[np.bool_]]


class LineProjector:
    """Projects the lines, `line_width` m wide, of one road in its driven direction."""

    def __init__(self, road: Road, camera: CameraSpec, line_width: float) -> None:
        self._camera = camera
        points = np.asarray(road.points)
        right = (np.asarray(road.right_edge) - points) / road.lane_width
        ahead = np.stack((-right[:, 1], right[:, 0]), axis=1)
        points = np.vstack((points[0] - LEAD_IN * ahead[0], points, points[-1] + LEAD_OUT * ahead[-1]))
        right = np.vstack((right[:1], right, right[-1:]))
        along = arc_lengths(points)
        stations = np.linspace(0.0, along[-1], math.ceil(along[-1] / STEP) + 1)
        points, right = (np.stack([np.interp(stations, along, p[:, i]) for i in (0, 1)], 1) for p in (points, right))
        inset = road.lane_width - line_width / 2
        self._borders = {
            name: tuple(points + (offset + side * line_width / 2) * right for side in (-1, 1))
            for name, offset in zip(LINES, (0.0, inset, -inset), strict=True)
        }

    def masks(self, state: VehicleState, window: Window, size: tuple[int, int]) -> dict[str, NDArray[np.bool_]]:
        """Project the lines into a window of the camera's image: a mask of `size`, (rows, columns), for each line."""
        camera, found = self._camera, {}
        for name, borders in self._borders.items():
            (low, low_depth), (high, high_depth) = (project(border, state, camera) for border in borders)
            seen = (np.minimum(low_depth, high_depth) > NEAREST) & (np.maximum(low_depth, high_depth) < FARTHEST)
            drawn = np.zeros((camera.height_px * SCALE, camera.width * SCALE), np.uint8)
            for i in np.flatnonzero(seen[:-1] & seen[1:]):
                quad = np.array([low[i], low[i + 1], high[i + 1], high[i]])
                if np.abs(quad).max() < 1e4:
                    # A pixel's centre is at a whole number; that of the drawing's first is half a pixel in.
                    cv2.fillConvexPoly(drawn, np.round(((quad + 0.5) * SCALE - 0.5) * 16).astype(np.int32), 255, 8, 4)
            part = drawn[window.top * SCALE : window.bottom * SCALE, window.left * SCALE : window.right * SCALE]
            small = cv2.resize(part, (size[1], size[0]), interpolation=cv2.INTER_AREA)
            found[name] = small >= 128
        return found


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
    """Find the lines in images, (rows, columns, 3) uint8 RGB each, and compare them with masks of `LineProjector`."""
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
