"""Where a vehicle is in the right lane: signed lateral position and arc length along the lane's centre line."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

WINDOW = 12
"""Segments searched either side of the last one; chosen: 12 are 9 m or more, a frame at 30 km/h is 0.42 m."""


class LaneTracker:
    """Follows a vehicle along a centre line, so that another part of the road that comes near is never taken for it.

    Args:
        centre_line: (n, 2) points in the order of driving, m, n >= 2.
    """

    def __init__(self, centre_line: NDArray[np.float64]) -> None:
        self._points = centre_line
        self._steps = np.diff(centre_line, axis=0)
        self._lengths = np.hypot(self._steps[:, 0], self._steps[:, 1])
        self._arc = np.concatenate(([0.0], np.cumsum(self._lengths)))
        self._nearest = 0

    @property
    def length(self) -> float:
        """Length of the centre line, m."""
        return float(self._arc[-1])

    def update(self, x: float, y: float) -> tuple[float, float]:
        """Move on to (x, y) and tell (lateral position, arc length), both in m; right of the line is positive."""
        lateral, arc, self._nearest = self._project(x, y)
        return lateral, arc

    def lateral_position(self, x: float, y: float) -> float:
        """Lateral position of another point near the vehicle, m, right positive; the vehicle is not moved."""
        return self._project(x, y)[0]

    def _project(self, x: float, y: float) -> tuple[float, float, int]:
        """Nearest point of the segments in the window; the two outer ends of the line run on straight."""
        first = max(0, self._nearest - WINDOW)
        last = min(len(self._steps), self._nearest + WINDOW + 1)
        steps, lengths = self._steps[first:last], self._lengths[first:last]
        to_x, to_y = x - self._points[first:last, 0], y - self._points[first:last, 1]
        along = (to_x * steps[:, 0] + to_y * steps[:, 1]) / lengths
        low = np.zeros_like(along)
        high = lengths.copy()
        if first == 0:
            low[0] = -math.inf
        if last == len(self._steps):
            high[-1] = math.inf
        along = np.clip(along, low, high)
        off_x = to_x - along * steps[:, 0] / lengths
        off_y = to_y - along * steps[:, 1] / lengths
        squared = off_x * off_x + off_y * off_y
        best = int(np.argmin(squared))
        side = steps[best, 0] * off_y[best] - steps[best, 1] * off_x[best]
        distance = math.sqrt(float(squared[best]))
        index = first + best
        return (-distance if side > 0 else distance), float(self._arc[index] + along[best]), index
