"""Finds the lane's lines in an image by colour and width alone, for simulated, real and translated images.

Nothing here is trained, so it cannot learn the mistakes of a generator; `docs/sim2real.md` shows it on photographs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

WIDEST = 0.14
"""Widest line, in widths of the image; chosen: tape on the photographed tracks is up to 0.12 wide at the bottom."""
MIN_YELLOW = 20.0
"""Least surplus of yellowness (a + b of CIE Lab) of a line over its surroundings; chosen on photographs: reflections
and wood reach 15, worn tape 25."""
YELLOW_ITSELF = 18.0
"""Least yellowness of the line itself; chosen on photographs: beige on blue has a surplus, but hardly any itself."""
MIN_WHITE = 20.0
"""Least surplus of whiteness (L minus chroma of CIE Lab) of a line over its surroundings; chosen on photographs:
reflections of lamps on the floor reach 15 to 25, lines 25 to 50."""
HALO = 0.03
"""Width of the rim of a yellow line that is not taken for white, in image widths; chosen: blur of photographs."""
SMALLEST = 6
"""Fewest pixels of a line's visible piece in an image of 160 columns; chosen: smaller ones are texture."""
REFERENCE_COLUMNS = 160

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Lines:
    """Pixels of the lines in an image.

    Attributes:
        yellow: (rows, columns) bool, the line to the left of the lane.
        white: (rows, columns) bool, the edges of the road.
    """

    yellow: Mask
    white: Mask


def find_lines(image: NDArray[np.uint8]) -> Lines:
    """Find the lines in an image, (rows, columns, 3) uint8 RGB."""
    lab = cv2.cvtColor(image.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    lightness, a, b = lab[..., 0], lab[..., 1], lab[..., 2]
    side = max(3, round(WIDEST * image.shape[1])) | 1
    smallest = round(SMALLEST * (image.shape[1] / REFERENCE_COLUMNS) ** 2)
    yellow = _without_specks((_ridges(a + b, side) > MIN_YELLOW) & (a + b > YELLOW_ITSELF), smallest)
    rim = round(HALO * image.shape[1]) | 1
    near_yellow = cv2.dilate(yellow.astype(np.uint8), np.ones((rim, rim), np.uint8)) > 0
    white = (_ridges(lightness - np.hypot(a, b), side) > MIN_WHITE) & ~near_yellow
    return Lines(yellow, _without_specks(white, smallest))


def lane_borders(lines: Lines) -> NDArray[np.float64]:
    """Columns of the yellow line and of the next white one to its right, (rows, 2); NaN where there is none.

    A run of pixels that touches the side of the image has no middle, so it does not count.
    """
    found = np.full((lines.yellow.shape[0], 2), np.nan)
    for row, (yellow, white) in enumerate(zip(lines.yellow, lines.white, strict=True)):
        middles = _run_middles(yellow)
        if not middles.size:
            continue
        found[row, 0] = middles[-1]
        edges = _run_middles(white)
        edges = edges[edges > middles[-1]]
        if edges.size:
            found[row, 1] = edges[0]
    return found


def _ridges(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Height of what is narrower than a square of `side` pixels above what is around it (a top-hat)."""
    reach = side // 2
    padded = cv2.copyMakeBorder(values, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    opened = cv2.morphologyEx(padded, cv2.MORPH_TOPHAT, np.ones((side, side), np.uint8))
    return np.asarray(opened[reach:-reach, reach:-reach], np.float32)


def _without_specks(mask: Mask, smallest: int) -> Mask:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = np.zeros(count, np.bool_)
    large[1:] = stats[1:, cv2.CC_STAT_AREA] >= smallest
    return np.asarray(large[labels], np.bool_)


def _run_middles(row: Mask) -> NDArray[np.float64]:
    """Middles of the runs of a row that do not touch its ends."""
    change = np.flatnonzero(np.diff(np.concatenate(([0], row.astype(np.int8), [0]))))
    begins, ends = change[::2], change[1::2]
    inside = (begins > 0) & (ends < row.size)
    return (begins[inside] + ends[inside] - 1) / 2.0
