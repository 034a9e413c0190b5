# SPDX-License-Identifier: Apache-2.0
"""How well two located recordings of one closed track agree: their centre lines, after the best rigid motion.

`python -m benchmarks.recording.halves LOCATED_A LOCATED_B`; a folder of `benchmarks.recording.drives` may stand for
LOCATED_B: its true line. Rotation, translation and starting station are free, the scale is not. Distances are those of
each line's points from the other line, in lane widths of A.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ds_recording.located import read_located
from ds_recording.track import Track

Array = NDArray[np.float64]
POINTS, DENSE = 400, 8000
"""Points of a line that are moved, and to which distances are taken: a lap of 63 lane widths in steps of 0.01."""
TURNS = 30
"""Steps of iterative closest points; chosen: the last ones move nothing."""


def even(line: Array, count: int) -> Array:
    """Points of a closed line at even steps, (count, 2)."""
    track = Track(line, True)
    stations = np.linspace(0.0, track.length, count, endpoint=False)
    closed = np.vstack((line, line[:1]))
    return np.column_stack([np.interp(stations, track.stations, column) for column in closed.T])


def moved(points: Array, onto: Array, others: Array | None = None) -> Array:
    """Points, or others, after the rigid motion that brings points nearest to their partners, after Kabsch."""
    middle, target = points.mean(axis=0), onto.mean(axis=0)
    left, _, right = np.linalg.svd((points - middle).T @ (onto - target))
    rotation = left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
    return np.asarray(((points if others is None else others) - middle) @ rotation + target)


def distances(a: Array, b: Array) -> Array:
    """Distances between two closed lines of the same driving direction after the best rigid motion, in their unit.

    Args:
        a: (n, 2) points of a closed line.
        b: (m, 2) points of the other.

    Returns:
        (2 * `POINTS`,) distances of the points of each line from the other line.
    """
    points, onto = even(b, POINTS), even(a, POINTS)
    starts = [np.roll(onto, -shift, axis=0) for shift in range(POINTS)]
    best = min(starts, key=lambda start: float(np.square(moved(points, start) - start).sum()))
    # Closest points, as lines of unlike lengths drift apart along the lap.
    dense, place = even(a, DENSE), moved(points, best)
    tree = KDTree(dense)
    for _ in range(TURNS):
        place = moved(place, dense[tree.query(place)[1]])
    return np.concatenate((tree.query(place)[0], KDTree(even(place, DENSE)).query(onto)[0]))


def main() -> None:
    """Align and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("a", type=Path)
    parser.add_argument("b", type=Path)
    arguments = parser.parse_args()
    located = read_located(arguments.a)
    line = np.loadtxt(arguments.b / "track.csv", delimiter=",", skiprows=1, usecols=(0, 1))
    if not located.track.closed:
        parser.error(f"{arguments.a}: its track is not closed: drive more than a lap")
    away = distances(located.track.points, line) / located.lane_width
    ratio = Track(line, True).length / located.track.length
    rms, most = float(np.sqrt(np.square(away).mean())), float(np.quantile(away, 0.95))
    print(f"length B / A {ratio:.3f}; distance of the centre lines: rms {rms:.2f}, 95% {most:.2f} lane widths")


if __name__ == "__main__":
    main()
