"""Projects the lines of a road through a camera: where they are in a simulated image, known exactly."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_driver.sim2real.window import Window
from ds_road import Road
from ds_sim.camera.projection import NEAREST, project
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


class LineProjector:
    """Projects the lines of one road.

    Args:
        road: a road in its driven direction.
        camera: camera of the simulator.
        line_width: width of the lines, m.
    """

    def __init__(self, road: Road, camera: CameraSpec, line_width: float) -> None:
        self._camera = camera
        points = np.asarray(road.points)
        right = (np.asarray(road.right_edge) - points) / road.lane_width
        ahead = np.stack((-right[:, 1], right[:, 0]), axis=1)
        points = np.vstack((points[0] - LEAD_IN * ahead[0], points, points[-1] + LEAD_OUT * ahead[-1]))
        right = np.vstack((right[:1], right, right[-1:]))
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        stations = np.linspace(0.0, along[-1], math.ceil(along[-1] / STEP) + 1)
        points, right = (np.stack([np.interp(stations, along, p[:, i]) for i in (0, 1)], 1) for p in (points, right))
        inset = road.lane_width - line_width / 2
        self._borders = {
            name: tuple(points + (offset + side * line_width / 2) * right for side in (-1, 1))
            for name, offset in zip(LINES, (0.0, inset, -inset), strict=True)
        }

    def masks(self, state: VehicleState, window: Window, size: tuple[int, int]) -> dict[str, NDArray[np.bool_]]:
        """Project the lines into a window of the camera's image.

        Args:
            state: vehicle when the image was exposed.
            window: part of the image.
            size: rows and columns of the result.

        Returns:
            For each of `LINES` a mask of `size`.
        """
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
            rows, columns = (slice(a * SCALE, b * SCALE) for a, b in _sides(window))
            small = cv2.resize(drawn[rows, columns], (size[1], size[0]), interpolation=cv2.INTER_AREA)
            found[name] = small >= 128
        return found


def _sides(window: Window) -> tuple[tuple[int, int], tuple[int, int]]:
    return (window.top, window.bottom), (window.left, window.right)
