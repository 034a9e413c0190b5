# SPDX-License-Identifier: Apache-2.0
"""Finds that a road closes to a lap, and joins its ends; lengths are in lane widths."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_recording.first_guess import SPACING
from ds_recording.track import Track, wrap

Array = NDArray[np.float64]
SHORTEST_LAP, OVERLAP = 10.0, 3.0
"""Shortest lap, and road that must have been driven twice; chosen: a circle as tight as cars turn, and a bend."""
LARGEST_TURN, LARGEST_GAP = 0.6, 0.12
"""Largest error of the turn of a lap (rad), and of its ends' distance (laps), before they are joined."""
ALIKE = 0.55
"""Largest standard deviation of the difference of direction between two laps, rad; chosen: half a lap has more."""
LONGER = 1.25
"""Laps up to so many times the shortest are compared; chosen: two rounds are not a lap."""


@dataclass(frozen=True, kw_only=True)
class Closed:
    """Closed centre line, and the poses on it as a new first guess."""

    track: Track
    poses: Array  # x, y, yaw without jumps, (n, 3)
    pieces: NDArray[np.int64]  # of the track, beside each pose, (n,)


def close_lap(track: Track, along: Array, lateral: Array, heading: Array) -> Closed | None:
    """Join the ends of a lap on an open line; None if nothing was driven twice, or does not look alike.

    Station, offset to the right, and heading relative to the line, are those of each pose, (n,).
    """
    spacing = float(track.lengths.mean())
    first, last = int(along.min() / spacing) + 1, int(along.max() / spacing)
    points = track.points[first : last + 1]
    directions = np.unwrap(np.arctan2(track.tangents[:, 1], track.tangents[:, 0]))[first : last + 1]
    best: tuple[float, int, float] | None = None
    shortest: int | None = None
    for lap in range(round(SHORTEST_LAP / spacing), len(points) - round(OVERLAP / spacing)):
        if shortest is not None and lap > LONGER * shortest:
            break
        apart = directions[lap:] - directions[:-lap]
        alike, turned = float(apart.std()), float(apart.mean())
        # Once around, or none in a figure of eight.
        turn = turned - 2.0 * math.pi * round(turned / (2.0 * math.pi))
        gap = float(np.hypot(*(points[lap] - points[0]))) / (lap * spacing)
        if alike > ALIKE or abs(turn) > LARGEST_TURN or gap > LARGEST_GAP:
            continue
        shortest = shortest or lap
        score = 50.0 * (alike / ALIKE) ** 2 + (turn / LARGEST_TURN) ** 2 + (gap / LARGEST_GAP) ** 2
        if best is None or score < best[0]:
            best = score, lap, turn
    if best is None:
        return None
    _, lap, turn = best
    line = _with_joined_ends(points[: lap + 1], directions[: lap + 1], turn)
    closed = Track(line, True).resampled(SPACING)
    station = ((along - first * spacing) / (lap * spacing) * closed.length) % closed.length
    piece = np.clip(np.searchsorted(closed.stations, station, side="right") - 1, 0, closed.pieces - 1)
    tangent = closed.tangents[piece]
    base = closed.points[piece] + (station - closed.stations[piece])[:, None] * tangent
    places = base + lateral[:, None] * np.stack((tangent[:, 1], -tangent[:, 0]), axis=1)
    middle = base + 1e-9 * tangent
    yaw = np.unwrap(wrap(closed.place(middle, piece)[2] + heading))
    return Closed(track=closed, poses=np.column_stack((places, yaw)), pieces=piece.astype(np.int64))


def _with_joined_ends(points: Array, directions: Array, turn: float) -> Array:
    """Line whose last point is its first, left out: the error of turn and place is spread evenly along it."""
    share = np.linspace(0.0, 1.0, len(points))
    steps = np.hypot(*np.diff(points, axis=0).T)
    turned = directions[:-1] - turn * 0.5 * (share[1:] + share[:-1])
    moves = steps[:, None] * np.stack((np.cos(turned), np.sin(turned)), axis=1)
    line = np.vstack((points[:1], points[0] + np.cumsum(moves, axis=0)))
    return np.asarray((line - share[:, None] * (line[-1] - line[0]))[:-1])
