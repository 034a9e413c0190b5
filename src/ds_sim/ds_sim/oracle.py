# SPDX-License-Identifier: Apache-2.0
"""Test oracle: where the vehicle is in its lane, and when and how a run ends (paper 3.1.3, 3.3)."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_sim.simulator import FRAME_RATE, Outcome

WINDOW = 12
"""Segments searched on either side of the last one; chosen: 12 are 9 m or more, one step at 30 km/h is 0.42 m."""


class LaneTracker:
    """Tracks a vehicle along a centre line.

    The search is limited to segments near the last position, so that another part of the road that passes close by is
    never matched.

    Args:
        centre_line: (n, 2) points in driving order, m, n >= 2.
    """

    def __init__(self, centre_line: NDArray[np.float64]) -> None:
        segments = np.diff(centre_line, axis=0)
        lengths = np.hypot(segments[:, 0], segments[:, 1])
        self._arc: list[float] = np.concatenate(([0.0], np.cumsum(lengths))).tolist()
        # Start x and y, vector x and y, length, and limits of the arc length along it. Numbers instead of arrays: a
        # window is too short for arrays to be faster.
        low, high = np.zeros_like(lengths), lengths.copy()
        low[0], high[-1] = -math.inf, math.inf
        self._segments: list[tuple[float, ...]] = np.column_stack(
            (centre_line[:-1], segments, lengths, low, high)
        ).tolist()
        self._nearest = 0

    @property
    def length(self) -> float:
        """Length of the centre line, m."""
        return self._arc[-1]

    def update(self, x: float, y: float) -> tuple[float, float]:
        """Move to (x, y), m; returns (lateral position, arc length), m, where right of the line is positive."""
        lateral, arc, self._nearest = self._project(x, y)
        return lateral, arc

    def lateral_position(self, x: float, y: float) -> float:
        """Lateral position of another point near the vehicle, m, right positive; does not move the vehicle."""
        return self._project(x, y)[0]

    def _project(self, x: float, y: float) -> tuple[float, float, int]:
        """Project onto the nearest segment in the window: lateral position and arc length, m, and the segment's index.

        The line is extended straight at both ends.
        """
        first = max(0, self._nearest - WINDOW)
        least, best, place, side = math.inf, first, 0.0, 0.0
        for index, segment in enumerate(self._segments[first : self._nearest + WINDOW + 1], first):
            start_x, start_y, ahead_x, ahead_y, length, low, high = segment
            to_x, to_y = x - start_x, y - start_y
            along = (to_x * ahead_x + to_y * ahead_y) / length
            if along < low:  # takes half the time of min and max
                along = low
            elif along > high:
                along = high
            off_x, off_y = to_x - along * ahead_x / length, to_y - along * ahead_y / length
            squared = off_x * off_x + off_y * off_y
            if squared < least:
                least, best, place = squared, index, along
                side = ahead_x * off_y - ahead_y * off_x
        distance = math.sqrt(least)
        return (-distance if side > 0 else distance), self._arc[best] + place, best


@dataclass(frozen=True, kw_only=True)
class OracleLimits:
    """Thresholds that end a run.

    Attributes:
        finish_margin: distance before the end of the lane at which the road counts as completed, m; chosen: about half
            a car, so that the front bumper reaches the last road point (maxitwo stops 8 m short of it).
        stuck_distance: a vehicle that covers less than this within `stuck_time` is stuck, m (maxitwo's detector, SBFT
            competition: 1 m).
        stuck_time: simulated time, s (the same detector: 10 s).
        max_steps: number of steps after which the run times out (maxitwo: 2000 steps).
    """

    finish_margin: float = 2.0
    stuck_distance: float = 1.0
    stuck_time: float = 10.0
    max_steps: int = 2000


class Oracle:
    """Judges one run.

    Args:
        lane_length: length of the lane's centre line, m.
        limits: thresholds that end the run.
    """

    def __init__(self, lane_length: float, limits: OracleLimits | None = None) -> None:
        self._limits = limits or OracleLimits()
        self._finish = lane_length - self._limits.finish_margin
        self._progress: deque[float] = deque(maxlen=round(self._limits.stuck_time * FRAME_RATE) + 1)

    def judge(self, *, step: int, lateral_distance: float, arc_length: float) -> Outcome:
        """Judge one frame; out of bounds takes precedence over anything else in the same frame.

        Args:
            step: steps since the start of the run.
            lateral_distance: half a lane minus |lateral position|, m.
            arc_length: distance along the lane's centre line, m.
        """
        self._progress.append(arc_length)
        if lateral_distance < 0.0:
            return Outcome.OUT_OF_BOUNDS
        if arc_length >= self._finish:
            return Outcome.COMPLETED
        full = len(self._progress) == self._progress.maxlen
        if full and max(self._progress) - min(self._progress) < self._limits.stuck_distance:
            return Outcome.STUCK
        if step >= self._limits.max_steps:
            return Outcome.TIMEOUT
        return Outcome.RUNNING
