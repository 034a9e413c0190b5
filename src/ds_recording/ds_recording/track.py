# SPDX-License-Identifier: Apache-2.0
"""Centre line of a road as a polyline of even steps, open or closed, and its file in RoboRacer's form."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ds_base.bounded_file import FileError, read_regular
from ds_base.folder_files import write_whole
from ds_recording import RecordingError
from ds_road import RoadError, importing

Array = NDArray[np.float64]
Index = NDArray[np.int64]
HEADER = "# x_m,y_m,w_tr_right_m,w_tr_left_m"
"""First line of a RoboRacer track file."""
MAX_TRACK_FILE = 2**24
"""Largest track file, bytes; chosen: some 300,000 points."""
MAX_LENGTH = 1000.0
"""Longest track that is read, m on the floor; chosen: ten laps of a large hall."""
_WALK = 12
"""Steps in which the nearest piece is found from a start near it; chosen: twice what was ever needed."""


@dataclass(frozen=True)
class Track:
    """Centre line."""

    points: Array  # (n, 2) in driving order, about `spacing` apart; a closed one does not repeat its first point
    closed: bool = False  # whether the last point is joined to the first

    @cached_property
    def _ends(self) -> Array:
        return np.roll(self.points, -1, axis=0) if self.closed else self.points[1:]

    @cached_property
    def lengths(self) -> Array:
        """Length of each piece, (n,) or (n - 1,)."""
        return np.hypot(*(self._ends - self.points[: len(self._ends)]).T)

    @cached_property
    def tangents(self) -> Array:
        """Unit vectors along each piece, (n, 2) or (n - 1, 2)."""
        return (self._ends - self.points[: len(self._ends)]) / self.lengths[:, None]

    @cached_property
    def stations(self) -> Array:
        """Arc length at the start of each piece, and at the end of the last."""
        return np.concatenate(([0.0], np.cumsum(self.lengths)))

    @property
    def length(self) -> float:
        """Length of the line."""
        return float(self.stations[-1])

    @property
    def pieces(self) -> int:
        """Number of straight pieces."""
        return len(self._ends)

    def wrapped(self, index: Index) -> Index:
        """Indices of points or pieces within the line: around a closed one, at the ends of an open one."""
        return index % len(self.points) if self.closed else np.clip(index, 0, self.pieces - 1)

    def nearest(self, places: Array, start: Index) -> Index:
        """Nearest piece to each place, (m, 2), found by walking along the line from a start, (m,)."""
        index = self.wrapped(start)
        for _ in range(_WALK):
            along = ((places - self.points[index]) * self.tangents[index]).sum(axis=1)
            step = np.clip(np.floor(along / self.lengths[index]), -8, 8).astype(np.int64)
            moved = self.wrapped(index + step)
            if (moved == index).all():
                break
            index = moved
        return index

    def place(self, places: Array, index: Index) -> tuple[Array, Array, Array]:
        """Station, offset to the right, and heading of the line at each place, given its nearest piece, (m,) each."""
        to, tangent = places - self.points[index], self.tangents[index]
        along = (to * tangent).sum(axis=1)
        share = np.clip(along / self.lengths[index], 0.0, 1.0)
        before, after = self.wrapped(index - 1), self.wrapped(index + 1)
        # The heading turns evenly from the middle of one piece to that of the next.
        own = np.arctan2(tangent[:, 1], tangent[:, 0])
        others = np.where((share < 0.5)[:, None], self.tangents[before], self.tangents[after])
        turn = wrap(np.arctan2(others[:, 1], others[:, 0]) - own)
        heading = own + turn * np.abs(share - 0.5)
        return self.stations[index] + along, to[:, 0] * tangent[:, 1] - to[:, 1] * tangent[:, 0], heading

    def beside(self, right: float | Array) -> Track:
        """The line moved to the right by a distance, one for all of its points or one for each, (n,)."""
        points = self.points
        ahead = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
        if not self.closed:
            ahead[0], ahead[-1] = points[1] - points[0], points[-1] - points[-2]
        ahead /= np.hypot(*ahead.T)[:, None]
        return Track(points + np.reshape(right, (-1, 1)) * np.column_stack((ahead[:, 1], -ahead[:, 0])), self.closed)

    def resampled(self, spacing: float) -> Track:
        """The same line with even steps of about this length, through a cubic spline."""
        points = np.vstack((self.points, self.points[:1])) if self.closed else self.points
        spline = CubicSpline(self.stations, points, bc_type="periodic" if self.closed else "not-a-knot")
        count = max(round(self.length / spacing), 4)
        stations = np.linspace(0.0, self.length, count + 1)
        return Track(np.asarray(spline(stations[:-1] if self.closed else stations)), self.closed)

    @cached_property
    def curvature(self) -> Array:
        """Change of heading over length at each point, left positive, (points,); 0 at the ends of an open line."""
        heading = np.arctan2(self.tangents[:, 1], self.tangents[:, 0])
        if self.closed:
            return wrap(heading - np.roll(heading, 1)) / (0.5 * (self.lengths + np.roll(self.lengths, 1)))
        inner = wrap(np.diff(heading)) / (0.5 * (self.lengths[1:] + self.lengths[:-1]))
        return np.concatenate(([0.0], inner, [0.0]))


def wrap(angle: Array) -> Array:
    """Angles within -pi to pi."""
    return np.asarray((angle + math.pi) % (2.0 * math.pi) - math.pi)


def write_track(path: Path, track: Track, half_width: float) -> None:
    """Write a RoboRacer track file; centre line, and distance from it to either edge line, m."""
    rows = [f"{x:.4f},{y:.4f},{half_width:.4f},{half_width:.4f}" for x, y in track.points.tolist()]
    write_whole(path, "\n".join([HEADER, *rows]) + "\n")


def read_track(path: Path) -> Track:
    """Read a RoboRacer track file, closed if its ends are at most two steps apart; RecordingError if it is none."""
    try:
        points, _ = importing.read_track(read_regular(path, MAX_TRACK_FILE))
    except (OSError, FileError, RoadError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path}: {reason!s:.200}: expected lines x_m,y_m,w_tr_right_m,w_tr_left_m") from None
    steps = np.hypot(*np.diff(points, axis=0).T)
    if len(points) < 4 or (steps <= 0.0).any():
        raise RecordingError(f"{path}: expected 4 or more points, of which no neighbours are the same")
    if not steps.sum() <= MAX_LENGTH:
        raise RecordingError(f"{path}: {steps.sum():.3g} m long, expected at most {MAX_LENGTH:g} m on the floor")
    return Track(points, bool(np.hypot(*(points[-1] - points[0])) <= 2.0 * np.median(steps)))
