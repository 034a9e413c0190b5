# SPDX-License-Identifier: Apache-2.0
"""Chooses pieces of a road that cover a share of it: bare pieces of line, patches, shadows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

GROUP = 6
"""Pieces in a row of which a share is covered as of all; chosen: shadows then change within 12 m, the view ahead."""


def pieces(
    rng: np.random.Generator, regions: Iterable[tuple[float, float]], length: float, share: float
) -> list[tuple[float, float]]:
    """Choose pieces that cover a share of every region, exactly, and more of the same for a larger share.

    The regions, (start, end) along a line, m, are in order and without gaps; `length` is that of a piece, m. What is
    covered is returned in order, neighbours joined.
    """
    spans: list[tuple[float, float]] = []
    for start, end in regions:
        count = max(1, round((end - start) / length))
        size = (end - start) / count
        wanted = share * count
        for rank, cell in enumerate(_spread(rng, count)):
            part = min(max(wanted - rank, 0.0), 1.0)
            if part > 0.0:
                spans.append((start + cell * size, start + (cell + part) * size))
    joined: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if joined and start - joined[-1][1] < 1e-9:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    return joined


def _spread(rng: np.random.Generator, count: int) -> list[int]:
    """Random order of some cells in which every neighbourhood takes its turn, so that a share is spread out."""
    groups = [rng.permutation(range(first, min(first + GROUP, count))).tolist() for first in range(0, count, GROUP)]
    turns = rng.permutation(len(groups)).tolist()
    return [groups[turn][place] for place in range(GROUP) for turn in turns if place < len(groups[turn])]


def gaps(covered: list[tuple[float, float]], start: float, end: float) -> Iterator[tuple[float, float]]:
    """What some pieces leave of a line from start to end."""
    for low, high in covered:
        if low > start + 1e-9:
            yield start, low
        start = high
    if end > start + 1e-9:
        yield start, end
