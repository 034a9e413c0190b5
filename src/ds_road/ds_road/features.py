"""Structural features of a road, from the samples of its centre line (paper 3.3; rules of DeepHyperion, maxitwo)."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

STRAIGHT = 0.005
"""Radians of heading change per sample that still count as straight (maxitwo)."""
SHORT_STRAIGHT, SHORT_RUN = 10, 15
"""Samples below which a straight, and any run, is too short to stand on its own (maxitwo)."""
WINDOW = 5
"""Samples that a circle of the curvature spans: its first, middle and last point (maxitwo)."""
DIRECTION_BINS = 25
"""Parts of the full circle into which directions fall (DeepHyperion)."""
LARGEST_RADIUS = 90.0
"""m; a road is called straight from there on (DeepHyperion)."""


def curvature(points: NDArray[np.float64]) -> float:
    """Largest curvature of the circles through samples i, i + 2, i + 4, in 1/m; 0 for a straight road.

    Menger's formula: four times the triangle's area over the product of its sides. The last window is left out, and
    an area below 5e-7 m2 counts as straight, as in maxitwo.
    """
    windows = len(points) - WINDOW
    if windows < 1:
        return 0.0
    first, middle, last = (points[k : k + windows] for k in (0, 2, 4))
    a, b, c = middle - first, last - middle, first - last
    twice_the_area = np.abs(a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1])
    bent = twice_the_area >= 1e-6
    sides = np.hypot(*a.T) * np.hypot(*b.T) * np.hypot(*c.T)
    return float(np.max(2.0 * twice_the_area[bent] / sides[bent], initial=0.0))


def turns_count(points: NDArray[np.float64], *, maxitwo_compatible: bool = False) -> int:
    """Number of turns.

    Args:
        points: (n, 2) samples of the centre line.
        maxitwo_compatible: wrap heading changes as maxitwo does, with degree constants on radians, so that a jump of
            a full turn stays in and counts as a bend; the default wraps at pi.
    """
    steps = np.diff(points, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    change = np.concatenate(([0.0], np.diff(heading)))
    half = 180.0 if maxitwo_compatible else math.pi
    change = (change + half) % (2 * half) - half
    labels = ["s" if abs(d) <= STRAIGHT else "l" if d > 0 else "r" for d in change]
    runs = [(label, len(list(group))) for label, group in groupby(labels)]
    runs = _absorb(runs, _joins_a_straight_or_the_same)
    runs = _absorb(runs, lambda label, length, previous: length < SHORT_RUN)
    return sum(label != "s" for label, _ in runs)


def minimum_radius(points: NDArray[np.float64]) -> float:
    """Radius of the circle that makes the `curvature`, m, at most `LARGEST_RADIUS` (DeepHyperion)."""
    largest = curvature(points)
    return min(1.0 / largest, LARGEST_RADIUS) if largest else LARGEST_RADIUS


def direction_coverage(points: NDArray[np.float64]) -> float:
    """Share of all directions in which the road leads, in [0, 1].

    As in DeepHyperion: angle between each step and north, 0 to 180 degrees whether to the left or to the right, in
    bins of 360 / 25 degrees; used bins over 26, the number of their ends. So a road can cover half of them at most.
    """
    steps = np.diff(points, axis=0)
    angles = np.degrees(np.arccos(np.clip(steps[:, 1] / np.hypot(*steps.T), -1.0, 1.0)))
    ends = np.linspace(0.0, 360.0, DIRECTION_BINS + 1)
    return len(np.unique(np.digitize(angles, ends))) / len(ends)


def _joins_a_straight_or_the_same(label: str, length: int, previous: str) -> bool:
    if label == "s":
        return length < SHORT_STRAIGHT
    return length < SHORT_RUN and label == previous


def _absorb(runs: list[tuple[str, int]], joins: Callable[[str, int, str], bool]) -> list[tuple[str, int]]:
    """Let runs that are too short become part of the run before them."""
    kept: list[tuple[str, int]] = []
    for label, length in runs:
        if kept and joins(label, length, kept[-1][0]):
            kept[-1] = (kept[-1][0], kept[-1][1] + length)
        else:
            kept.append((label, length))
    return kept
