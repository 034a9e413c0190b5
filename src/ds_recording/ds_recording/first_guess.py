# SPDX-License-Identifier: Apache-2.0
"""First guess of the road: lines of neighbouring frames, joined by the motion between them, vote for the road's shape.

About the car the road is an arc (offset, heading, curvature). All shapes of a grid are tried at once, and the most
likely sequence over the whole run is chosen (Viterbi), so that a frame whose lines are ambiguous is decided by others.
Lengths are in lane widths.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import splev, splprep

from ds_recording.lines import LinePoints
from ds_recording.motion import moved
from ds_recording.track import Track, wrap

Array = NDArray[np.float64]
EVERY, AROUND = 4, 12
"""Frames from one guess to the next, and frames on either side whose lines vote; chosen: half a second at 20 Hz."""
NEAR, REACH = 4.0, 2.5
"""Distance at which a frame's lines are still used, and about the car for which a shape is tried; chosen."""
HEADINGS = np.radians(np.arange(-52.0, 53.0, 4.0))
CURVATURES = np.arange(-1.0, 1.05, 0.1)
BIN = 0.1
"""Steps of the grid; chosen: each about a line's width at `REACH`."""
_OFFSETS = np.arange(-1.6, 1.65, BIN)
BEST = 10
"""Shapes of a moment that the sequence may choose from."""
LEAST_VOTES = 8.0
"""Votes below which a moment says nothing."""
SPACING = 0.25
"""Length of a piece of the track; chosen: sixteen pieces a quarter circle of the tightest curve there is."""


def arc_offsets(points: Array, headings: Array, curvatures: Array) -> Array:
    """Distance of points, (n, 2), to the left of arcs through the origin, in closed form, (m, n).

    Headings are the direction of each arc at the origin, (m,) rad; curvatures are left positive, (m,).
    """
    cos, sin = np.cos(headings)[:, None], np.sin(headings)[:, None]
    x, y = points.T
    along, left, k = cos * x + sin * y, cos * y - sin * x, curvatures[:, None]
    bend = k * (along**2 + left**2)
    return np.asarray((2.0 * left - bend) / (1.0 + np.sqrt(np.maximum(1.0 - 2.0 * k * left + k * bend, 0.0))))


def chained(steps: Array) -> Array:
    """Poses x, y, yaw, (n + 1, 3), from the motion between neighbours, (n, 3), starting at the origin."""
    yaw = np.concatenate(([0.0], np.cumsum(steps[:, 2])))
    cos, sin = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    x = np.cumsum(cos * steps[:, 0] - sin * steps[:, 1])
    y = np.cumsum(sin * steps[:, 0] + cos * steps[:, 1])
    return np.stack((np.concatenate(([0.0], x)), np.concatenate(([0.0], y)), yaw), axis=1)


def guess_track(lines: list[LinePoints], poses: Array) -> Track | None:
    """Guess the centre line along a dead-reckoned path, (n, 3), from the lines of each frame.

    It reaches from behind the first pose to ahead of the last; None if hardly any frame shows one.
    """
    moments = np.arange(0, len(lines), EVERY)
    candidates = [candidate_shapes(*_joined(lines, poses, int(i))) for i in moments]
    chosen = _sequence(candidates, poses[moments])
    kept = [(pose, shape) for pose, shape in zip(poses[moments], chosen, strict=True) if shape is not None]
    if len(kept) < max(8, 0.3 * len(moments)):
        return None
    centres, directions = [], []
    for (x, y, yaw), (offset, heading, _, _) in kept:
        direction = yaw + heading
        centres.append((x - offset * np.sin(direction), y + offset * np.cos(direction)))
        directions.append(direction)
    line = _smooth(np.array(centres), np.array(directions))
    return None if line is None else Track(line).resampled(SPACING)


def _joined(lines: list[LinePoints], poses: Array, at: int) -> tuple[Array, NDArray[np.bool_]]:
    """Points of lines about a frame's car, of that frame and its neighbours."""
    points, white = [], []
    for other in range(max(at - AROUND, 0), min(at + AROUND + 1, len(lines))):
        near = lines[other].floor[:, 0] < NEAR
        back = np.array([*poses[at, :2], poses[at, 2]])
        cos, sin = np.cos(poses[other, 2]), np.sin(poses[other, 2])
        x, y = lines[other].floor[near].T
        world = np.stack((cos * x - sin * y + poses[other, 0], sin * x + cos * y + poses[other, 1]), axis=1)
        points.append(moved(world, back))
        white.append(lines[other].white[near])
    positions, colour = np.concatenate(points), np.concatenate(white)
    kept = np.flatnonzero(np.abs(positions[:, 0]) < REACH)
    kept = kept[np.linspace(0, len(kept) - 1, 160).astype(int)] if len(kept) > 160 else kept
    return positions[kept], colour[kept]


def candidate_shapes(points: Array, white: NDArray[np.bool_]) -> Array:
    """Likely shapes of the road about the car, from points of lines ahead and left of it, (n, 2), some white, (n,).

    Each is offset to the right, heading of the road, curvature and votes, (`BEST` or fewer, 4).
    """
    if len(points) < LEAST_VOTES:
        return np.zeros((0, 4))
    headings, curvatures = (grid.ravel() for grid in np.meshgrid(HEADINGS, CURVATURES))
    left = arc_offsets(points, headings, curvatures)
    votes = np.zeros((len(headings), len(_OFFSETS)))
    rows = np.arange(len(headings))[:, None]
    for shift, voters in ((0.0, ~white), (1.0, white), (-1.0, white)):
        place = np.round((left[:, voters] - shift - _OFFSETS[0]) / BIN).astype(int)
        inside = (place >= 0) & (place < len(_OFFSETS))
        np.add.at(votes, (np.broadcast_to(rows, place.shape)[inside], place[inside]), 1.0)
    # A straight road ahead of a car along it is the likeliest; neighbours share a vote that falls between them.
    votes[:, 1:-1] += 0.5 * (votes[:, :-2] + votes[:, 2:])
    votes -= 0.01 * len(points) * (np.abs(headings) / 0.5 + np.abs(curvatures) / 0.5)[:, None]
    shapes = []
    left_votes = votes.copy()
    for _ in range(BEST):
        row, column = np.unravel_index(int(left_votes.argmax()), votes.shape)
        if votes[row, column] < LEAST_VOTES:
            break
        shapes.append((_OFFSETS[column], headings[row], curvatures[row], votes[row, column]))
        close = (np.abs(headings - headings[row]) < 0.15) & (np.abs(curvatures - curvatures[row]) < 0.25)
        left_votes[close, max(column - 2, 0) : column + 3] = -np.inf
    return np.array(shapes) if shapes else np.zeros((0, 4))


def _sequence(candidates: list[Array], poses: Array) -> list[Array | None]:
    """Most likely candidate of each moment, as a sequence; None where there is none."""
    with_shapes = [i for i, shapes in enumerate(candidates) if len(shapes)]
    chosen: list[Array | None] = [None] * len(candidates)
    if not with_shapes:
        return chosen
    scores = [_merit(candidates[with_shapes[0]])]
    origins = []
    for before, after in pairwise(with_shapes):
        first, second = candidates[before], candidates[after]
        step = moved(poses[after : after + 1, :2], poses[before])
        ahead = arc_offsets(step, first[:, 1], first[:, 2])[:, 0]
        turn = poses[after, 2] - poses[before, 2]
        offset = first[:, 0] - ahead
        heading = first[:, 1] + first[:, 2] * step[0, 0] - turn
        far = 1.0 + 0.3 * (after - before - 1)
        apart = ((offset[:, None] - second[:, 0]) / 0.15) ** 2 + (wrap(heading[:, None] - second[:, 1]) / 0.1) ** 2
        apart += ((first[:, 2][:, None] - second[:, 2]) / 0.2) ** 2
        total = scores[-1][:, None] - np.minimum(apart / far, 30.0) / 30.0
        origins.append(total.argmax(axis=0))
        scores.append(total.max(axis=0) + _merit(second))
    index = int(scores[-1].argmax())
    for place in range(len(with_shapes) - 1, -1, -1):
        chosen[with_shapes[place]] = candidates[with_shapes[place]][index]
        if place:
            index = int(origins[place - 1][index])
    return chosen


def _merit(shapes: Array) -> Array:
    return np.asarray(shapes[:, 3] / max(float(shapes[:, 3].max()), 30.0))


def _smooth(centres: Array, directions: Array) -> Array | None:
    """Smooth line through points of the road, extended straight at both ends."""
    ahead = np.diff(centres, axis=0)
    forward = ahead[:, 0] * np.cos(directions[:-1]) + ahead[:, 1] * np.sin(directions[:-1])
    kept = np.concatenate(([True], forward > 0.02))
    points = centres[kept]
    if len(points) < 6:
        return None
    arcs = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    spline, _ = splprep(points.T, u=arcs, w=np.full(len(points), 10.0), s=len(points))
    stations = np.arange(0.0, arcs[-1], SPACING)
    line = np.stack(splev(stations, spline), axis=1)
    ends = [along / np.hypot(*along) for along in (line[0] - line[1], line[-1] - line[-2])]
    behind = line[0] + np.arange(2.0, 0.0, -SPACING)[:, None] * ends[0]
    beyond = line[-1] + np.arange(SPACING, 2.0, SPACING)[:, None] * ends[1]
    return np.vstack((behind, line, beyond))
