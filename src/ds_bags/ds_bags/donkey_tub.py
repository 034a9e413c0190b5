# SPDX-License-Identifier: Apache-2.0
"""Reads Donkey Car tubs of version 2: images, commands and times that a car recorded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_bags.layout import BagError, plain_name, printable
from ds_base.bounded_file import FileError, load_json, read_words
from ds_base.errors import InputError

MAX_FILE = 64 * 2**20
"""Bytes of a manifest or catalog; chosen: donkeycar begins a new catalog after 1,000 records, some 300 kB."""
MAX_TEXT = 512 * 2**20
"""Bytes of all catalogs; chosen: as many records as a tub may have."""
MAX_LINE = 2**20
"""Characters of a record, and of the manifest's lines; chosen: a thousand times the usual one."""
MAX_RECORDS = 1_000_000
"""Records of a tub; chosen: fourteen hours at 20 Hz."""
_LARGEST = 2**53


class TubError(InputError):
    """A folder that is no tub, or one that is damaged."""


@dataclass(frozen=True, kw_only=True)
class TubRecord:
    """One moment of a tub.

    Steering is the command to the car, -1 full left to +1 full right: the sign is Donkey Car's (donkeycar,
    parts/actuator.py, PWMSteering.LEFT_ANGLE) and this project's.
    """

    index: int  # in the tub
    seconds: float  # wall clock
    image: Path | None  # in the tub's folder `images`
    steering: float | None
    throttle: float | None  # command to the car, at most 1, negative backwards
    fields: dict[str, Any]  # all values of the record


@dataclass(frozen=True, kw_only=True)
class Tub:
    """A tub.

    Attributes:
        records: in their order, without the deleted ones.
        files: that hold them.
    """

    records: tuple[TubRecord, ...]
    files: tuple[Path, ...]

    @property
    def pictures(self) -> list[tuple[TubRecord, Path]]:
        """Records that have an image, with its file."""
        return [(record, record.image) for record in self.records if record.image is not None]

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time of each record, (n,), s."""
        return np.array([record.seconds for record in self.records], dtype=np.float64)

    @property
    def commands(self) -> NDArray[np.float64]:
        """Steering and throttle of each record, (n, 2); NaN where it has none."""
        return np.array([(r.steering, r.throttle) for r in self.records], dtype=np.float64).reshape(-1, 2)

    def numbers(self, *keys: str) -> NDArray[np.float64]:
        """First finite number of each record, (n,), among these fields; NaN where it has none."""
        rows = [[number(record.fields.get(key)) for key in keys] for record in self.records]
        return np.array([next((v for v in values if v is not None), np.nan) for values in rows], dtype=np.float64)


def is_tub(folder: Path) -> bool:
    """Whether a folder looks like a tub."""
    return (folder / "manifest.json").exists()


def read_tub(folder: Path) -> Tub:
    """Read the records of a tub in their order, without those that its user deleted.

    Raises:
        TubError: no tub of version 2, a damaged one, or one that names files outside its folder.
    """
    try:
        index = _object(_text(folder / "manifest.json").splitlines()[4])
        deleted = set(index.get("deleted_indexes", []))
        names = [plain_name(name) for name in index["paths"]]
        if len(set(names)) < len(names):
            raise ValueError("a catalog is named twice")
        files = tuple(folder / name for name in names)
        records: list[TubRecord] = []
        left = MAX_TEXT
        for file in files:
            text = _text(file)
            left -= len(text)
            if left < 0:
                raise ValueError(f"its catalogs have more than {MAX_TEXT // 2**20} MiB")
            rows = (_object(line) for line in text.splitlines() if line.strip())
            records += (_record(folder, row) for row in rows if row["_index"] not in deleted)
            if len(records) > MAX_RECORDS:
                raise ValueError(f"more than {MAX_RECORDS} records")
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        reason = printable(" ".join(str(error).split()))
        raise TubError(f"{folder}: not a tub of version 2 ({type(error).__name__}: {reason}): copy it again") from None
    return Tub(records=tuple(records), files=files)


def _text(file: Path) -> str:
    try:
        return read_words(file, MAX_FILE)
    except FileError as error:
        raise BagError(f"{file.name}: {error}") from None


def _object(line: str) -> dict[str, Any]:
    if len(line) > MAX_LINE:
        raise ValueError(f"a record has more than {MAX_LINE // 2**10} KiB")
    value = load_json(line)
    if not isinstance(value, dict):
        raise ValueError(f"a line is a {type(value).__name__}, expected an object")
    return value


def _record(folder: Path, row: dict[str, Any]) -> TubRecord:
    # The pilot's values where it drove, as donkeycar's DriveMode has it.
    mode = row.get("user/mode", "user")
    steering = number(row.get("pilot/angle") if mode != "user" else row.get("user/angle"))
    throttle = number(row.get("pilot/throttle") if mode == "local" else row.get("user/throttle"))
    name = row.get("cam/image_array")
    index, milliseconds = number(row["_index"]), number(row["_timestamp_ms"])
    if index is None or milliseconds is None or max(abs(index), abs(milliseconds)) > _LARGEST:
        raise ValueError("_index and _timestamp_ms of a record: expected numbers")
    return TubRecord(
        index=int(index),
        seconds=milliseconds / 1000.0,
        image=folder / "images" / plain_name(name) if isinstance(name, str) else None,
        steering=None if steering is None else min(max(steering, -1.0), 1.0),
        throttle=None if throttle is None else min(throttle, 1.0),
        fields=row,
    )


def number(value: object) -> float | None:
    """Return a finite number as it is; None for anything else that a record may hold."""
    try:
        return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
    except OverflowError:
        return None
