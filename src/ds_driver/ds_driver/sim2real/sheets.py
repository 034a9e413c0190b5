"""Sheets of pictures to look at while generators train."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

GAP = 4
"""White pixels between pictures."""


def sheet(rows: Sequence[Sequence[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """Arrange pictures of one size in rows, which may differ in length: (rows, columns, 3) uint8 RGB."""
    height, width = rows[0][0].shape[:2]
    longest = max(map(len, rows))
    page = np.full((len(rows) * (height + GAP) - GAP, longest * (width + GAP) - GAP, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, picture in enumerate(row):
            top, left = i * (height + GAP), j * (width + GAP)
            page[top : top + height, left : left + width] = picture
    return page
