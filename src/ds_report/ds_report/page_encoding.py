"""Encodings of what a page contains: pictures as addresses, lines of roads and drives as packed text.

Roads and drives are smooth, so that the second differences of their coordinates in whole centimetres are almost all 0
or 1, and deflate needs about three bits for each.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.encodings import png


def data_address(picture: NDArray[np.uint8]) -> str:
    """Encode an RGB picture, (rows, columns, 3) uint8, as the address of a PNG."""
    return f"data:image/png;base64,{base64.b64encode(png(picture)).decode()}"


UNITS = 100.0
"""Units per metre, or per full lock of the steering; chosen: a centimetre is less than a pixel of any picture."""
EVERY = 2
"""Every second frame of a drive is kept, and its last one; chosen: 10 Hz, 0.8 m at full speed."""
_FARTHEST = 2**24
"""Largest coordinate in units, 168 km; larger ones from a faulty simulator are clipped."""

Columns = Sequence[NDArray[np.float64]]


def kept(steps: int) -> NDArray[np.intp]:
    """Select the frames from 0 to `steps` that a report keeps."""
    return np.unique(np.append(np.arange(0, steps + 1, EVERY), steps))


def pack(columns: Columns) -> str:
    """Pack columns of finite numbers as base64 text.

    Format: deflate (zlib) over the lowest bytes of all numbers, then the second, third and highest bytes. The numbers
    are uint32: the second differences of one column after the other, in 1 / `UNITS`, n >= 0 as 2 n and n < 0 as
    -2 n - 1, so that all but the lowest bytes are nearly always 0.
    """
    numbers = [_second_differences(column) for column in columns]
    whole = np.concatenate(numbers) if numbers else np.empty(0, np.int64)
    planes = np.where(whole >= 0, 2 * whole, -2 * whole - 1).astype("<u4").view(np.uint8).reshape(-1, 4).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()


def _second_differences(column: NDArray[np.float64]) -> NDArray[np.int64]:
    """Compute the second differences of a column, in units, with zeros before its first value."""
    units = np.round(np.clip(UNITS * column, -_FARTHEST, _FARTHEST)).astype(np.int64)
    return np.diff(np.diff(units, prepend=0), prepend=0)
