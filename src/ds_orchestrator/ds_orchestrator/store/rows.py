# SPDX-License-Identifier: Apache-2.0
"""Checks rows of a campaign's store: SQLite enforces no column types, and a received file may hold anything."""

from __future__ import annotations

import hashlib
import json
import math
import re
import zlib
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError

LONGEST_TEXT = 10_000
"""Characters of a message, name or fact; chosen: far above the longest one that a campaign writes."""
LONGEST_ROAD = 200_000
"""Characters of a road's control points as JSON; chosen: four times 1000 points with all digits."""
MOST_STEPS = 1_000_000
"""Frames of one run; chosen: 500 times the limit of the built-in oracle."""
_COLUMNS = 5
_SHA256 = 64


class RowError(InputError):
    """Value that no campaign can have written; the message names the column."""


def text(value: object, name: str, *, longest: int = LONGEST_TEXT) -> str:
    """Check that a value is text of bounded length."""
    if not isinstance(value, str):
        raise RowError(f"{name} is {_kind(value)}, expected text")
    if len(value) > longest:
        raise RowError(f"{name} has {len(value)} characters, expected at most {longest}")
    return value


def one_of(value: object, name: str, known: Collection[str]) -> str:
    """Check that a value is one of the known words."""
    if text(value, name) not in known:
        raise RowError(f"{name} is {value!r:.60}, expected one of {', '.join(known)}")
    return str(value)


def file_name(value: object, name: str) -> str:
    """Check that a value is text that is safe within a file name."""
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,200}", text(value, name)):
        raise RowError(f"{name} is {value!r:.60}, expected letters, digits, _, - and .")
    return str(value)


def whole(value: object, name: str, *, low: int = 0, high: int = 2**63 - 1) -> int:
    """Check that a value is a whole number within bounds."""
    if not isinstance(value, int):
        raise RowError(f"{name} is {_kind(value)}, expected a whole number")
    if not low <= value <= high:
        raise RowError(f"{name} is {value}, expected {low} to {high}")
    return value


def real(value: object, name: str, *, low: float = -math.inf, high: float = math.inf) -> float:
    """Check that a value is a finite number within bounds; SQLite stores NaN as NULL."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        shown = value if isinstance(value, float) else _kind(value)
        raise RowError(f"{name} is {shown}, expected a finite number")
    if not low <= value <= high:
        raise RowError(f"{name} is {value}, expected {low:g} to {high:g}")
    return float(value)


def seconds(value: str, name: str) -> float:
    """Parse a duration in seconds that is stored as text."""
    try:
        found = float(value) if len(value) < 30 else math.nan
    except ValueError:
        found = math.nan
    if not math.isfinite(found) or found < 0:
        raise RowError(f"{name!r:.60} is {value!r:.60}, expected seconds")
    return found


def sha256(value: object, name: str) -> str:
    """Check that a value is a SHA-256 digest, hexadecimal."""
    if not re.fullmatch(f"[0-9a-f]{{{_SHA256}}}", text(value, name)):
        raise RowError(f"{name} is {value!r:.60}, expected {_SHA256} hexadecimal digits")
    return str(value)


def bag_folder(value: object) -> str:
    """Check that a value names a bag in the campaign's folder `bags`, or is ""."""
    path = text(value, "bag")
    if path and not re.fullmatch(r"bags/(?!\.+$)[A-Za-z0-9_.-]{1,255}", path):
        raise RowError(f"bag is {path!r:.60}, expected a folder in bags")
    return path


def control_points(value: object) -> list[Any]:
    """Parse a road's control points; checks only that they are a JSON list."""
    try:
        points = json.loads(text(value, "control_points", longest=LONGEST_ROAD))
    except RowError:
        raise
    except (ValueError, RecursionError):
        raise RowError("control_points is not JSON") from None
    if not isinstance(points, list):
        raise RowError("control_points is not a list")
    return points


def pack_numbers(values: NDArray[np.float64]) -> bytes:
    """Compress numbers for the store."""
    return zlib.compress(values.tobytes())


def unpack_numbers(packed: object, name: str, *, count: int) -> NDArray[np.float64]:
    """Decompress what `pack_numbers` wrote, with memory bounded by the expected count.

    Args:
        packed: value of the column.
        name: name of the column, for messages.
        count: expected number of values.

    Raises:
        RowError: the value is damaged, holds another number of values, or one that is not finite.
    """
    if not isinstance(packed, bytes):
        raise RowError(f"{name} is {_kind(packed)}, expected bytes")
    expected = 8 * count
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, expected + 1)
        if len(content) == expected and not unpacker.eof:
            content += unpacker.decompress(unpacker.unconsumed_tail, 1)
    except zlib.error:
        raise RowError(f"{name} is damaged") from None
    if len(content) != expected or not unpacker.eof or unpacker.unused_data:
        raise RowError(f"{name} does not hold {count} numbers")
    values = np.frombuffer(content, dtype=np.float64)
    if not np.isfinite(values).all():
        raise RowError(f"{name} holds NaN or infinity")
    return values


def unpack_trajectory(packed: object, digest: str, *, steps: int) -> NDArray[np.float64]:
    """Decompress a trajectory and check its digest.

    Returns:
        (steps + 1, 5), or (0, 5) for a run without observations.

    Raises:
        RowError: the trajectory is damaged, of another length, not finite, or has another digest.
    """
    empty = steps == 0 and digest == trajectory_sha256(np.empty((0, _COLUMNS)))
    rows = 0 if empty else steps + 1
    trajectory = unpack_numbers(packed, "trajectory", count=_COLUMNS * rows).reshape(rows, _COLUMNS)
    if trajectory_sha256(trajectory) != digest:
        raise RowError("trajectory does not match its stored SHA-256")
    return trajectory


def trajectory_sha256(trajectory: NDArray[np.float64]) -> str:
    """Compute SHA-256 over the little-endian float64 bytes of x, y, yaw and speed, the initial state included.

    Args:
        trajectory: (n, 4 or more); further columns are ignored.
    """
    return hashlib.sha256(np.ascontiguousarray(trajectory[:, :4], dtype="<f8").tobytes()).hexdigest()


def _kind(value: object) -> str:
    return {type(None): "empty", bytes: "a blob", str: "text", float: "a fraction", int: "a whole number"}.get(
        type(value), type(value).__name__
    )
