"""A road as a picture, seen from above as in the paper's figure 2."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road.road import Road

GRASS, ASPHALT, WHITE, YELLOW = (120, 165, 105), (105, 105, 110), (245, 245, 245), (235, 200, 40)
RED, BLACK = (215, 40, 40), (20, 20, 20)
PALETTE = ((31, 119, 180), (255, 127, 14), (214, 39, 140), (148, 103, 189), (0, 190, 190))
"""Colours of trajectories, in order; told apart by readers who do not see red or green."""
Pixels = Callable[[NDArray[np.float64]], NDArray[np.int32]]
_MARGIN = 8.0
_SHIFT = 4


def draw(
    road: Road, *, trajectories: Mapping[str, NDArray[np.float64]] | None = None, size: int = 640, caption: bool = True
) -> NDArray[np.uint8]:
    """Draw a road: edges white, centre yellow, control points as red stars, start as triangle, end as square.

    Args:
        road: to draw, valid or not.
        trajectories: name -> (n, 2) positions, m, drawn over the road with a legend.
        size: of the longer side of the picture, pixels.
        caption: write id, length and features below.

    Returns:
        (rows, columns, 3) uint8 RGB.
    """
    control = np.array(road.control_points)
    paths = {name: np.asarray(path)[:, :2] for name, path in (trajectories or {}).items()}
    everything = np.vstack((road.left_edge, road.right_edge, control, *paths.values()))
    low, high = everything.min(axis=0) - _MARGIN, everything.max(axis=0) + _MARGIN
    scale = size / float((high - low).max())
    width, height = (max(int(round(v)), 320) for v in (high - low) * scale)
    image = np.full((height, width, 3), GRASS, np.uint8)

    def pixels(points: NDArray[np.float64]) -> NDArray[np.int32]:
        flipped = np.stack((points[:, 0] - low[0], high[1] - points[:, 1]), axis=1)
        return np.round(flipped * scale * (1 << _SHIFT)).astype(np.int32)

    def line(points: NDArray[np.float64], colour: tuple[int, int, int], thickness: int) -> None:
        cv2.polylines(image, [pixels(points)], False, colour, thickness, cv2.LINE_AA, _SHIFT)

    quads = np.stack((road.left_edge[:-1], road.left_edge[1:], road.right_edge[1:], road.right_edge[:-1]), axis=1)
    for quad in quads:
        cv2.fillConvexPoly(image, pixels(quad), ASPHALT, cv2.LINE_8, _SHIFT)
    for edge in (road.left_edge, road.right_edge):
        line(edge, WHITE, 2)
    line(road.points, YELLOW, 2)
    for (name, path), colour in zip(paths.items(), PALETTE * (1 + len(paths) // len(PALETTE)), strict=False):
        line(path, colour, 2)
        row = 22 + 20 * list(paths).index(name)
        cv2.line(image, (10, row - 5), (34, row - 5), colour, 3, cv2.LINE_AA)
        _write(image, name, (42, row))
    for x, y in pixels(control) / (1 << _SHIFT):
        cv2.drawMarker(image, (int(x), int(y)), RED, cv2.MARKER_STAR, 10, 1, cv2.LINE_AA)
    _ends(image, road, pixels)
    _scale_bar(image, scale)
    if not caption:
        return image
    text = [
        f"{road.road_id}   {road.length:.0f} m",
        f"turns {road.turns_count}   curvature {road.curvature:.3f} /m",
        "valid" if road.validity.valid else f"not valid: {road.validity.reason}",
    ]
    footer = np.full((16 + 20 * len(text), width, 3), 255, np.uint8)
    for index, content in enumerate(text):
        _write(footer, content, (10, 22 + 20 * index))
    return np.vstack((image, footer))


def _ends(image: NDArray[np.uint8], road: Road, pixels: Pixels) -> None:
    """A black triangle where the vehicle starts, pointing ahead, and a black square at the end."""
    lane = road.right_lane_centre
    ahead = lane[1] - lane[0]
    ahead = ahead / np.hypot(*ahead)
    across = np.array((ahead[1], -ahead[0]))
    triangle = np.stack((lane[0] + 4.0 * ahead, lane[0] + 1.6 * across, lane[0] - 1.6 * across))
    square = lane[-1] + 1.5 * np.array(((-1, -1), (1, -1), (1, 1), (-1, 1)))
    for shape in (triangle, square):
        cv2.fillConvexPoly(image, pixels(shape), BLACK, cv2.LINE_AA, _SHIFT)


def _scale_bar(image: NDArray[np.uint8], scale: float) -> None:
    """Ten or fifty metres at the lower right."""
    metres = 10 if 10 * scale > 40 else 50
    right, row = image.shape[1] - 12, image.shape[0] - 12
    left = int(right - metres * scale)
    cv2.line(image, (left, row), (right, row), BLACK, 2, cv2.LINE_AA)
    _write(image, f"{metres} m", (left, row - 6))


def _write(image: NDArray[np.uint8], text: str, at: tuple[int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, BLACK, 1, cv2.LINE_AA)
