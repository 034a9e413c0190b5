# SPDX-License-Identifier: Apache-2.0
"""Draws a road seen from above, as in figure 2 of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road.road import Road, RoadError

GRASS, ASPHALT, WHITE, YELLOW = (120, 165, 105), (105, 105, 110), (245, 245, 245), (235, 200, 40)
RED, BLACK = (215, 40, 40), (20, 20, 20)
PALETTE = ((31, 119, 180), (255, 127, 14), (214, 39, 140), (148, 103, 189), (0, 190, 190))
"""Colours of trajectories, in order; distinguishable with red-green colour blindness."""
SMALLEST, LARGEST = 320, 4000
"""Limits of the longer side, pixels; chosen: the caption fits, and drawing takes a few hundred megabytes at most."""
_MARGIN = 10.0
_TRAJECTORY_MARGIN = 30.0
_SUPERSAMPLING = 3
_SHIFT = 4
_FAR = 2.0**28
_ROW = 20
_STRIP = 30


@dataclass(frozen=True)
class _View:
    """Supersampled canvas, scaled down at the end for smooth lines, and its place in the road frame."""

    canvas: NDArray[np.uint8]
    left: float
    top: float
    scale: float

    def pixels(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Convert points in the road frame (m) to canvas coordinates in units of 1/16 pixel."""
        flipped = np.stack((points[:, 0] - self.left, self.top - points[:, 1]), axis=1)
        return np.round(np.clip((flipped * self.scale - 0.5) * (1 << _SHIFT), -_FAR, _FAR)).astype(np.int32)

    def fill(self, points: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
        cv2.fillPoly(self.canvas, [self.pixels(points)], colour, cv2.LINE_8, _SHIFT)

    def line(self, points: NDArray[np.float64], colour: tuple[int, int, int], width: float) -> None:
        thickness = max(round(width * _SUPERSAMPLING), 1)
        cv2.polylines(self.canvas, [self.pixels(points)], False, colour, thickness, cv2.LINE_8, _SHIFT)

    def disc(self, centre: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
        """Draw a disc with a white rim, the same size in every picture."""
        (x, y), one = self.pixels(centre[None])[0].tolist(), _SUPERSAMPLING << _SHIFT
        for pixels, inner in ((6, WHITE), (4, colour)):
            cv2.circle(self.canvas, (x, y), pixels * one, inner, cv2.FILLED, cv2.LINE_8, _SHIFT)


def draw(
    road: Road, *, trajectories: Mapping[str, NDArray[np.float64]] | None = None, size: int = 640, caption: bool = True
) -> NDArray[np.uint8]:
    """Draw a road: white edges, yellow centre line, start as triangle, end as square.

    Control points are red stars; with trajectories, whose ends are marked by discs, they are left out.

    Args:
        road: road to draw, valid or not.
        trajectories: name -> (n, 2) positions, m, drawn over the road with a legend. A trajectory that strays more
            than 30 m from the area of the road is cut off at the border of the picture.
        size: longer side of the picture without its caption, pixels, 320 to 4000.
        caption: whether to write id, length and features below the picture.

    Returns:
        (rows, columns, 3) uint8 RGB.

    Raises:
        RoadError: the size is out of range, or a trajectory is not an array of finite positions.

    Examples:
        >>> from ds_road import Road, draw
        >>> draw(Road([(125, 0), (125, 25), (125, 50), (140, 75)])).shape
        (716, 400, 3)
    """
    if not SMALLEST <= size <= LARGEST:
        raise RoadError(f"picture size is {size}, expected {SMALLEST} to {LARGEST} pixels")
    paths = {name: _path(name, path) for name, path in (trajectories or {}).items()}
    view = _view_of(road, list(paths.values()), size)
    for quad in np.stack((road.left_edge[:-1], road.left_edge[1:], road.right_edge[1:], road.right_edge[:-1]), axis=1):
        view.fill(quad, ASPHALT)
    for edge in (road.left_edge, road.right_edge):
        view.line(edge, WHITE, 2)
    view.line(road.points, YELLOW, 2)
    colours = [PALETTE[index % len(PALETTE)] for index in range(len(paths))]
    for path, colour in zip(paths.values(), colours, strict=True):
        view.line(path, colour, 2)
    if not road.sampled and not paths:
        for point in road.control_points:
            _star(view, np.array(point))
    _ends(view, road)
    for path, colour in zip(paths.values(), colours, strict=True):
        if len(path):
            view.disc(path[-1], colour)
    rows, columns = (side // _SUPERSAMPLING for side in view.canvas.shape[:2])
    image = np.asarray(cv2.resize(view.canvas, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
    _legend(image, dict(zip(paths, colours, strict=True)))
    _scale_bar(image, view.scale / _SUPERSAMPLING)
    return np.vstack((image, _caption(road, columns))) if caption else image


def _path(name: str, path: NDArray[np.float64]) -> NDArray[np.float64]:
    positions = np.asarray(path, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] < 2 or not np.isfinite(positions[:, :2]).all():
        raise RoadError(f"trajectory {name}: array of shape {positions.shape}, expected (n, 2) finite metres")
    return positions[:, :2]


def _view_of(road: Road, paths: list[NDArray[np.float64]], size: int) -> _View:
    """Empty canvas that covers the whole road, and the trajectories where they stay near it."""
    surface = np.vstack((road.left_edge, road.right_edge, np.array(road.control_points)))
    low, high = surface.min(axis=0), surface.max(axis=0)
    near = np.vstack((surface, *(np.clip(path, low - _TRAJECTORY_MARGIN, high + _TRAJECTORY_MARGIN) for path in paths)))
    low, high = near.min(axis=0) - _MARGIN, near.max(axis=0) + _MARGIN
    width, height = (float(side) for side in high - low)
    scale = min(size / width, (size - _STRIP) / height)
    columns, rows = max(round(width * scale), size * 5 // 8), max(round(height * scale) + _STRIP, size * 5 // 8)
    middle = (low + high) / 2 - (0.0, _STRIP / 2 / scale)  # space for the scale bar below the road
    canvas = np.full((rows * _SUPERSAMPLING, columns * _SUPERSAMPLING, 3), GRASS, np.uint8)
    left, top = middle + np.array((-columns, rows)) / (2 * scale)
    return _View(canvas, float(left), float(top), scale * _SUPERSAMPLING)


def _star(view: _View, centre: NDArray[np.float64]) -> None:
    """Draw a red five-pointed star with a dark rim, the same size in every picture."""
    angle = np.pi / 2 + np.arange(10) * np.pi / 5
    radius = np.where(np.arange(10) % 2 == 0, 1.0, 0.42)
    shape = np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=1)
    for pixels, colour in ((9.5, BLACK), (7.0, RED)):
        view.fill(centre + shape * pixels * _SUPERSAMPLING / view.scale, colour)


def _ends(view: _View, road: Road) -> None:
    """Mark the start with a black triangle that points ahead, and the end with a black square."""
    lane, half = road.lane_centre, 0.4 * road.lane_width
    triangle = np.array(((2.4, 0.0), (0.0, 1.0), (0.0, -1.0)))
    square = np.array(((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)))
    for shape, at, step in ((triangle, lane[0], lane[1] - lane[0]), (square, lane[-1], lane[-1] - lane[-2])):
        ahead = step / np.hypot(*step)
        axes = np.array((ahead, (ahead[1], -ahead[0])))
        view.fill(at + half * shape @ axes, BLACK)


def _legend(image: NDArray[np.uint8], colours: Mapping[str, tuple[int, int, int]]) -> None:
    """Write the names of the trajectories at the upper left."""
    for index, (name, colour) in enumerate(colours.items()):
        row = 22 + _ROW * index
        cv2.line(image, (10, row - 5), (34, row - 5), colour, 3, cv2.LINE_AA)
        _write(image, name, (42, row))


def _scale_bar(image: NDArray[np.uint8], scale: float) -> None:
    """Draw a scale bar at the lower right: a round number of metres, at most a fifth of the picture wide."""
    max_length = image.shape[1] / 5 / scale
    power = 10.0 ** np.floor(np.log10(max_length))
    metres = max(factor * power for factor in (1, 2, 5) if factor * power <= max_length)
    right, row = image.shape[1] - 14, image.shape[0] - 14
    left = round(right - metres * scale)
    cv2.line(image, (left, row), (right, row), BLACK, 2)
    for end in (left, right):
        cv2.line(image, (end, row - 4), (end, row + 4), BLACK, 2)
    _write(image, f"{metres:g} m", (left, row - 10))


def _caption(road: Road, width: int) -> NDArray[np.uint8]:
    """White footer with id, features and validity."""
    text = [
        f"{road.road_id}   {road.length:.0f} m{'   left lane' if road.lane == 'left' else ''}",
        f"turns {road.turns_count}   curvature {road.curvature:.3f} /m",
        "valid" if road.validity.valid else f"not valid: {road.validity.reason}",
    ]
    footer = np.full((16 + _ROW * len(text), width, 3), 255, np.uint8)
    for index, content in enumerate(text):
        _write(footer, content, (10, 22 + _ROW * index))
    return footer


def _write(image: NDArray[np.uint8], text: str, at: tuple[int, int]) -> None:
    """Write black text, scaled down if it would exceed the width of the picture."""
    available = image.shape[1] - at[0] - 6
    width = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)[0][0]
    cv2.putText(
        image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45 * min(1.0, available / max(width, 1)), BLACK, 1, cv2.LINE_AA
    )
