# SPDX-License-Identifier: Apache-2.0
"""Outcomes of drives on a real car: read from CSV, checked, and kept apart from simulated drives."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path, PurePath
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError

from ds_analysis.common.outcome_table import STUDY, is_study
from ds_base.bounded_file import LARGEST_FILE, FileError, read_regular
from ds_base.errors import InputError
from ds_base.folder_files import read_file, write_json

FOLDER = "real"
"""Folder of proposals and real drives within a campaign's."""
DRIVES = "drives.json"
COLUMNS = ("test_id", "outcome", "who", "when")
"""Columns that a CSV must have; who and when may be given for all rows instead."""
OPTIONAL = ("max_lateral_position", "note")
OUTCOMES = {"completed": False, "failed": True, "out_of_bounds": True, "stuck": True, "timeout": True}
"""Outcome -> whether it is a failure."""
MOST_ROWS = 10_000
"""Rows of a CSV; chosen: a lifetime of drives."""
LARGEST_OFFSET = 1e6
"""m; chosen: that of a road's coordinates."""
_LONGEST = 200
Text = Annotated[str, Field(max_length=_LONGEST)]


class RecordError(InputError):
    """Outcomes of real drives that cannot be used."""


@dataclass(frozen=True, kw_only=True)
class RealDrive:
    """Outcome of one test on a real car."""

    test_id: Text
    failed: bool
    outcome: Text
    # Largest absolute lateral position of a completed drive, m of the road frame (the car's metres times the scale);
    # None if it was not measured.
    max_lateral_position: Annotated[float, Field(ge=0.0, le=LARGEST_OFFSET)] | None
    who: Text
    when: Text  # date, or date and time, ISO 8601
    source: Text
    note: Text = ""
    drawn: bool = False  # whether the person says that its test was drawn at random from all, where it was not proposed


_KEPT = TypeAdapter(Annotated[list[RealDrive], Field(max_length=MOST_ROWS)])


def read_csv(
    path: Path, limits: Mapping[str, float], *, scale: float, who: str | None = None, when: str | None = None
) -> list[RealDrive]:
    """Read outcomes from a CSV with the columns `COLUMNS`, and `OPTIONAL` if wanted.

    `limits` has the lateral position at which each test fails, half the width of its lane, m of the road frame; `scale`
    is metres of that frame per metre of the car's; `who` and `when` are for drives of which the file does not say. One
    line of a `RecordError` says which row is wrong, and what was expected.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_regular(path, LARGEST_FILE).decode("utf-8-sig"), newline=""))
        heads = [head.strip() for head in reader.fieldnames or []]
        reader.fieldnames = heads
        rows = [row for row, _ in zip(reader, range(MOST_ROWS + 1), strict=False)]
    except (OSError, FileError, UnicodeDecodeError, csv.Error) as error:
        raise RecordError(f"{path}: cannot be read ({error}): expected a CSV file") from None
    twice = [name for name in (*COLUMNS, *OPTIONAL) if heads.count(name) > 1]
    if twice:
        raise RecordError(f"{path}: the column {twice[0]} comes twice: remove one of them")
    defaults = {"who": who, "when": when}
    missing = [name for name in COLUMNS if name not in heads and not defaults.get(name)]
    if missing:
        raise RecordError(f"{path}: no column {missing[0]}, expected the columns {', '.join((*COLUMNS, *OPTIONAL))}")
    if not rows:
        raise RecordError(f"{path}: no rows, expected one for each drive")
    if len(rows) > MOST_ROWS:
        raise RecordError(f"{path}: more than {MOST_ROWS} rows")
    drives = []
    for number, row in enumerate(rows, start=2):
        values = {name: (row.get(name) or defaults.get(name) or "").strip() for name in (*COLUMNS, *OPTIONAL)}
        try:
            drives.append(drive_of(values, limits, scale, path.name))
        except RecordError as error:
            raise RecordError(f"{path}, line {number}: {error}") from None
    return drives


def drive_of(values: Mapping[str, str], limits: Mapping[str, float], scale: float, source: str) -> RealDrive:
    """Check one drive, given as the text of every one of `COLUMNS` and `OPTIONAL`; for the rest see `read_csv`."""
    test_id, outcome = values["test_id"], values["outcome"].lower()
    if test_id not in limits:
        raise RecordError(f"there is no test {test_id!r:.60}: expected one of {_some(limits)}")
    if outcome not in OUTCOMES:
        raise RecordError(f"outcome {values['outcome']!r:.40}: expected one of {', '.join(OUTCOMES)}")
    for name in ("who", "when"):
        if not values[name]:
            raise RecordError(f"{name} is empty: fill it in, or give --{name}")
    try:
        datetime.fromisoformat(values["when"])
    except ValueError:
        raise RecordError(f"when is {values['when']!r:.40}, expected a date such as 2026-03-01") from None
    lateral = _lateral(values["max_lateral_position"], scale)
    half_lane = limits[test_id]
    if lateral is not None:
        contradicts = {"completed": lateral > half_lane, "out_of_bounds": lateral < half_lane}
        if contradicts.get(outcome):
            where = f"a lateral position of {lateral / scale:g} m: the lane's edge is at {half_lane / scale:g} m"
            raise RecordError(f"{outcome.replace('_', ' ')} with {where}")
    return RealDrive(
        test_id=test_id,
        failed=OUTCOMES[outcome],
        outcome=outcome,
        max_lateral_position=None if OUTCOMES[outcome] else lateral,
        who=values["who"][:_LONGEST],
        when=values["when"],
        source=source[-_LONGEST:],
        note=values["note"][:_LONGEST],
    )


def _lateral(text: str, scale: float) -> float | None:
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (0.0 <= value * scale <= LARGEST_OFFSET):
        raise RecordError(f"max_lateral_position is {text!r:.40}, expected metres on the car's road, 0 or more")
    return value * scale


def _some(names: Collection[str]) -> str:
    shown = sorted(names)[:6]
    return ", ".join(shown) + (f" and {len(names) - len(shown)} more" if len(names) > len(shown) else "")


def added(drives: Sequence[RealDrive], new: Sequence[RealDrive]) -> list[RealDrive]:
    """Add drives to those that are kept; one that is kept already stays as it is."""
    drive_of_test = {drive.test_id: drive for drive in drives}
    for drive in new:
        before = drive_of_test.setdefault(drive.test_id, drive)
        laterals = {before.max_lateral_position, drive.max_lateral_position} - {None}
        if before.failed != drive.failed or len(laterals) > 1:
            raise RecordError(
                f"test {drive.test_id} has two outcomes: {_said(before)}, and {_said(drive)}: decide which one holds, "
                "and remove the other"
            )
    return list(drive_of_test.values())


def _said(drive: RealDrive) -> str:
    lateral = "" if drive.max_lateral_position is None else f" at {drive.max_lateral_position:g} m"
    return f"{drive.outcome}{lateral} ({drive.who}, {drive.when}, {drive.source})"


def read_drives(folder: Path) -> list[RealDrive]:
    """Read the real drives of a folder, if any: the car's rows of a study, then those recorded, which agree with it."""
    if not is_study(folder):
        return read_recorded(folder)
    from ds_analysis.outcomes.study import read_study

    study = read_study(folder)
    imported = [
        RealDrive(
            test_id=test_id,
            failed=failed,
            outcome="failed" if failed else "completed",
            max_lateral_position=None,
            who="imported",
            when="",
            source=STUDY,
            drawn=study.car_drawn,
        )
        for test_id, failed in study.car_outcomes().items()
    ]
    return added(imported, read_recorded(folder))


def read_recorded(folder: Path) -> list[RealDrive]:
    """Read the drives that `write_drives` kept; empty if there are none."""
    path = folder / FOLDER / DRIVES
    try:
        drives = _KEPT.validate_json(read_file(folder, PurePath(FOLDER, DRIVES)), strict=True)
    except FileNotFoundError:
        return []
    except ValidationError as error:
        place = ", ".join(map(str, error.errors()[0]["loc"]))
        raise RecordError(
            f"{path} cannot be read ({place:.60}): restore it, or remove it and record the drives again"
        ) from None
    for drive in drives:
        if OUTCOMES.get(drive.outcome) != drive.failed or (drive.failed and drive.max_lateral_position is not None):
            raise RecordError(f"{path}: the drive of {drive.test_id!r:.60} is damaged: record it again")
    return added([], drives)


def write_drives(folder: Path, drives: Sequence[RealDrive]) -> Path:
    """Write the real drives of a campaign's folder, in the order in which they were recorded; returns the file."""
    path = folder / FOLDER / DRIVES
    write_json(path, [asdict(drive) for drive in drives])
    return path
