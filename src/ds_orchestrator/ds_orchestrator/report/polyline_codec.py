"""Lines of a report's tests as short texts: second differences, deflated, in base64; a browser unpacks them on a click.

A road or a drive is a smooth line, so that second differences of its whole centimetres are almost all 0 or 1, and
deflate makes about three bits of each.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

UNITS = 100.0
"""Units in a metre, or in full lock of the steering; chosen: a centimetre is less than a pixel of any picture."""
EVERY = 2
"""Every so many frames of a drive one is kept, and its last one; chosen: 10 Hz, at full speed 0.8 m apart."""
_FARTHEST = 2**24
"""Units, 168 km; a simulator may say anything, a report must not break."""

Columns = Sequence[NDArray[np.float64]]


def kept(steps: int) -> NDArray[np.intp]:
    """Which of the frames 0 to `steps` a report keeps."""
    return np.unique(np.append(np.arange(0, steps + 1, EVERY), steps))


def pack(columns: Columns) -> str:
    """Columns of finite numbers as base64 text.

    Inside: deflate (zlib) over the lowest bytes of all numbers, then the next ones, four times. The numbers are uint32,
    the second differences of one column after the other, in 1 / `UNITS`: n from 0 on as 2 n, others as -2 n - 1, so
    that all but the lowest bytes are nearly always 0.
    """
    numbers = [_second_differences(column) for column in columns]
    whole = np.concatenate(numbers) if numbers else np.empty(0, np.int64)
    planes = np.where(whole >= 0, 2 * whole, -2 * whole - 1).astype("<u4").view(np.uint8).reshape(-1, 4).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()


def _second_differences(column: NDArray[np.float64]) -> NDArray[np.int64]:
    """From a column's values to the differences of its differences, both beginning from 0."""
    units = np.round(np.clip(UNITS * column, -_FARTHEST, _FARTHEST)).astype(np.int64)
    return np.diff(np.diff(units, prepend=0), prepend=0)
