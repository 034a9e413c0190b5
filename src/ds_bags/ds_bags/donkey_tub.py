"""Reads Donkey Car tubs of version 2: what the car saw, what it was told, and when."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any


class TubError(ValueError):
    """A folder that is no tub, or one that is damaged."""


@dataclass(frozen=True, kw_only=True)
class TubRecord:
    """One moment of a tub.

    Attributes:
        index: of the record in the tub.
        seconds: wall clock.
        image: file, or None if the record has none.
        steering: that the car was told, -1 full left to +1 full right, or None. The sign is Donkey Car's (donkeycar,
            parts/actuator.py, PWMSteering.LEFT_ANGLE) and ours.
        throttle: that the car was told, at most 1, negative backwards, or None.
        fields: everything that the record says.
    """

    index: int
    seconds: float
    image: Path | None
    steering: float | None
    throttle: float | None
    fields: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Tub:
    """A tub.

    Attributes:
        records: in their order, without the deleted ones.
        files: that hold them.
    """

    records: tuple[TubRecord, ...]
    files: tuple[Path, ...]


def is_tub(folder: Path) -> bool:
    """Whether a folder looks like a tub."""
    return (folder / "manifest.json").is_file()


def read_tub(folder: Path) -> Tub:
    """The records of a tub in their order, without those that its user deleted.

    Raises:
        TubError: no tub of version 2.
    """
    try:
        index = json.loads((folder / "manifest.json").read_text().splitlines()[4])
        deleted = set(index.get("deleted_indexes", []))
        files = tuple(folder / name for name in index["paths"])
        rows = [json.loads(line) for file in files for line in file.read_text().splitlines() if line.strip()]
        records = tuple(_record(folder, row) for row in rows if row["_index"] not in deleted)
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise TubError(
            f"{folder}: not a tub of version 2 ({type(error).__name__}: {error}): convert or copy it"
        ) from None
    return Tub(records=records, files=files)


def _record(folder: Path, row: dict[str, Any]) -> TubRecord:
    # The pilot's values where it drove, as donkeycar's DriveMode has it.
    mode = row.get("user/mode", "user")
    steering = number(row.get("pilot/angle") if mode != "user" else row.get("user/angle"))
    throttle = number(row.get("pilot/throttle") if mode == "local" else row.get("user/throttle"))
    name = row.get("cam/image_array")
    return TubRecord(
        index=int(row["_index"]),
        seconds=float(row["_timestamp_ms"]) / 1000.0,
        image=folder / "images" / name if isinstance(name, str) else None,
        steering=None if steering is None else min(max(steering, -1.0), 1.0),
        throttle=None if throttle is None else min(throttle, 1.0),
        fields=row,
    )


def number(value: object) -> float | None:
    """A finite number as it is; None for anything else that a record may hold."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
