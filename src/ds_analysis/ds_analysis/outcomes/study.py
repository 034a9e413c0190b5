# SPDX-License-Identifier: Apache-2.0
"""A study: imported outcomes in one Parquet file, which every verb that only reads takes like a campaign."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from ds_analysis.common.outcome_table import MOST_TESTS, STUDY, OutcomeTable, OutcomeTableError, RoadTable, State
from ds_analysis.outcomes.columns import (
    Columns,
    ImportNotes,
    Margin,
    Rule,
    Verdict,
    as_list,
    column_of,
    features_of,
    is_empty,
    numbers_of,
    place_of,
    row_of,
    texts_of,
    verdicts_of,
)
from ds_analysis.outcomes.sbft import read_competition
from ds_base.bounded_file import FileError, load_json
from ds_base.bounded_tables import plain_cell, read_csv, read_parquet
from ds_base.folder_files import whole_file, write_whole
from ds_orchestrator.search.features import column_axis
from ds_sim.conditions.model import FIELDS
from ds_sim.registry import SimulatorName

KEY = b"digital siblings study 1"
"""Key of the metadata of that file."""
BINS, MOST_BINS, MOST_REPEATS = 10, 200, 2**31
"""Bins of an axis whose width nobody gave, and of any axis; number of a repetition."""
LONG = ("test_id", "repeat", "simulator", "failed", "margin", "limit", "family")
"""Columns of the file, then the features."""
_TEXTS = ("test_id", "simulator", "family")
CONDITIONS = {f"condition_{name}": name for name in FIELDS}
"""Column of a condition in SI units -> its name."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """Imported outcomes."""

    # One for each drive, with the columns `LONG`, the features, and the conditions; `margin` and `limit` are NaN where
    # only the verdict is known.
    rows: pd.DataFrame
    features: tuple[str, ...]
    axes: dict[str, float]  # feature -> width of a bin of the map
    twin: SimulatorName | None = None  # simulator that the others are to predict
    # Real car whose rows are drives, not a simulator's; with `car_drawn`, of tests drawn at random from all.
    car: str | None = None
    car_drawn: bool = False
    # Columns `condition_NAME` in SI units, of conditions that a campaign changed; empty where the simulator chooses.
    # The features have the same as shares of their ranges.
    conditions: tuple[str, ...] = ()

    @property
    def simulators(self) -> list[SimulatorName]:
        """Names, the twin last, without the car."""
        names = [SimulatorName(name) for name in dict.fromkeys(self.rows["simulator"]) if name != self.car]
        return sorted(names, key=lambda name: name == self.twin)

    def car_outcomes(self) -> dict[str, bool]:
        """Test -> whether the real car failed it, in the order of the rows; a repeated one if at least half failed."""
        of = self.rows[self.rows["simulator"] == self.car]
        return {
            str(test): bool(share >= 0.5) for test, share in of.groupby("test_id", sort=False)["failed"].mean().items()
        }

    def flakiness(self) -> dict[str, tuple[int, int, float, float | None]]:
        """Simulator -> tests, drives, share of failed drives, and of repeated tests whose repeats disagree, if any."""
        rates: dict[str, tuple[int, int, float, float | None]] = {}
        for name in (*self.simulators, *([self.car] if self.car else [])):
            of = self.rows[self.rows["simulator"] == name]
            shares = of.groupby("test_id")["failed"].agg(["mean", "size"])
            repeated = shares[shares["size"] > 1]["mean"]
            flaky = float(((repeated > 0) & (repeated < 1)).mean()) if len(repeated) else None
            rates[name] = (len(shares), len(of), float(of["failed"].mean()), flaky)
        return rates

    def table(self) -> OutcomeTable:
        """Make the table that everything reads; repeats count once: median margin, or failed where half of them did."""
        first = self.rows.drop_duplicates("test_id")
        if len(first) > MOST_TESTS:
            raise OutcomeTableError(f"{len(first)} tests, expected at most {MOST_TESTS}: import fewer")
        names = self.simulators
        middle = self.rows.groupby(["test_id", "simulator"]).agg(
            {"failed": "mean", "margin": "median", "limit": "median"}
        )
        failed, margins, limits = (
            middle[name].unstack().reindex(index=first["test_id"], columns=names).to_numpy(np.float64)
            for name in ("failed", "margin", "limit")
        )
        verdicts = np.where(failed >= 0.5, State.FAILED, State.COMPLETED)
        binned = [np.floor(first[name].to_numpy(np.float64) / width) for name, width in self.axes.items()]
        return OutcomeTable(
            test_ids=tuple(map(str, first["test_id"])),
            siblings=tuple(name for name in names if name != self.twin),
            twin=self.twin,
            axes=tuple(column_axis(name, width) for name, width in self.axes.items()),
            cells=tuple(tuple(map(int, cell)) for cell in zip(*binned, strict=True)),
            states=np.where(np.isnan(failed), State.MISSING, verdicts).astype(np.int8),
            lateral=np.where(np.isnan(failed), 0.0, margins),
            limits=np.where(np.isfinite(limits), limits, 1.0),
            feature_names=self.features,
            features=first[list(self.features)].to_numpy(np.float64).reshape(len(first), len(self.features)),
            families=pd.factorize(first["family"])[0].astype(np.intp),
        )


def import_outcomes(tables: Sequence[Path], columns: Columns, notes: ImportNotes | None = None) -> Study:
    """Read tables, CSV or Parquet: the first has the outcomes, each other one further columns for every test.

    Folders are read as SBFT's test files, one for each simulator. A row without a test, simulator, verdict or needed
    margin is left out, and a column that is no feature, too: see `ImportNotes`, by default the first refuses. One line
    of an `OutcomeTableError` says what is wrong, in which row.
    """
    notes = notes or ImportNotes()
    source = tables[0].name
    folders = [path for path in tables if path.is_dir()]
    if folders:
        columns = columns.model_copy(update={"repeat": columns.repeat or "repeat"})
    frame = read_competition(folders, notes.rows) if folders else read_frame(tables[0])
    tests = as_list(columns.test)
    for path in (path for path in tables[1:] if path not in folders):
        frame = _joined(frame, path, tests, source)
    columns = columns.filled(list(frame.columns))
    frame = frame[np.all([np.ones(len(frame), bool), *(one.holds(frame, source)[0] for one in columns.where)], axis=0)]
    if not len(frame):
        raise OutcomeTableError(f"{source} has no rows{' where they have to be' if columns.where else ''}")
    used = {*tests, *as_list(columns.simulator)}
    parts, outcomes = _outcomes(frame, columns, source, notes)
    rows = pd.concat(parts, ignore_index=True)
    test_of = pd.Series(texts_of(frame, tests, source))
    kept = test_of.isin(rows["test_id"]).to_numpy()
    owners = [] if columns.simulators is None else list(columns.simulators)
    ours = list(frame.columns[: len(LONG)]) == list(LONG)
    conditions = [name for name in CONDITIONS if ours and name in frame]
    features = features_of(
        frame[kept].drop(columns=conditions),
        test_of[kept].tolist(),
        columns.features,
        used | outcomes,
        notes,
        source,
        owners=None if ours else owners,
        failed=None if ours or rows["test_id"].duplicated().any() else rows.set_index("test_id")["failed"].astype(bool),
    )
    names = list(features.columns)
    if not names:
        raise OutcomeTableError(f"{source} has no feature: name columns with numbers that are known before a drive")
    of_test = frame[conditions].set_axis(test_of).groupby(level=0).first()
    rows = rows.join(features, on="test_id").join(of_test, on="test_id")
    twice = rows.duplicated(["test_id", "repeat", "simulator"])
    if twice.any():
        one = rows[twice].iloc[0]
        hint = "" if columns.repeat else ": name the column of the repetition as repeat"
        raise OutcomeTableError(f"{source}: test {one.test_id} comes twice on {one.simulator}{hint}")
    if len(names) < 2:
        raise OutcomeTableError(f"{source} has one feature, {names[0]}: expected two or more, which span the maps")
    axes = columns.map or axes_of(rows, _spanning(rows, names))
    for name in axes:
        if name not in names:
            raise OutcomeTableError(f"{source}: the map's axis {name!r} is no feature: expected {', '.join(names)}")
    for name, width in axes.items():
        if not float(np.ptp(rows[name])) <= MOST_BINS * width:
            raise OutcomeTableError(f"{source}: bins of {width:g} cut {name} into more than {MOST_BINS}: widen them")
    simulators = sorted(set(rows["simulator"]))
    for role in (columns.twin, columns.car):
        if role is not None and role not in simulators:
            raise OutcomeTableError(f"{source} has no simulator {role!r}: expected {', '.join(simulators)}")
    study = Study(
        rows=rows[[*LONG, *names, *conditions]],
        features=tuple(names),
        axes=axes,
        twin=columns.twin,
        car=columns.car,
        car_drawn=columns.car_drawn,
        conditions=tuple(conditions),
    )
    if not study.simulators or columns.car == columns.twin is not None:
        raise OutcomeTableError(f"{source}: the car is {columns.car!r}: expected a simulator beside it, and no twin")
    return study


def _joined(frame: pd.DataFrame, path: Path, tests: list[str], source: str) -> pd.DataFrame:
    """Add the columns of a table with a row for each test."""
    more = read_frame(path)
    keys = texts_of(more, tests, path.name)
    more = more.set_axis(pd.Index(keys, name="test of the row"))[[key != "" for key in keys]]
    if more.index.has_duplicates:
        raise OutcomeTableError(f"{path}: several rows have the same {', '.join(tests)}, expected one each test")
    of_row = more.drop(columns=tests).reindex(texts_of(frame, tests, source)).set_axis(frame.index)
    return pd.concat([frame, of_row.rename(columns={n: f"{n} of {path.stem}" for n in of_row if n in frame})], axis=1)


def _spanning(rows: pd.DataFrame, names: Sequence[str]) -> list[str]:
    """First two features, of numbers rather than of 0 and 1, and of two columns, where there are such."""
    ordered = sorted(names, key=lambda name: bool(rows[name].isin((0.0, 1.0)).all()))
    column = ordered[0].partition("=")[0].removesuffix(" missing")
    others = sorted(ordered[1:], key=lambda name: name.partition("=")[0].removesuffix(" missing") == column)
    return [ordered[0], others[0]]


def read_frame(path: Path) -> pd.DataFrame:
    """Read a table, CSV or Parquet; the index of CSV is the line."""
    if path.suffix.lower() in (".parquet", ".pq"):
        return cast(pd.DataFrame, _read(read_parquet, path).to_pandas(ignore_metadata=True))
    return cast(pd.DataFrame, _read(read_csv, path))


def _read(read: Callable[[Path], Any], path: Path) -> Any:
    try:
        return read(path)
    except OSError as error:
        raise OutcomeTableError(f"{path}: cannot be read ({error.strerror or error}): check the path") from None
    except FileError as error:
        raise OutcomeTableError(f"{path}: {error}") from None


def _outcomes(
    frame: pd.DataFrame, columns: Columns, source: str, notes: ImportNotes
) -> tuple[list[pd.DataFrame], set[str]]:
    """Return the rows of each simulator, and the columns that say what became of a test."""
    if columns.simulators is not None:
        verdicts = [(_driven(frame, one, source), name, one) for name, one in columns.simulators.items()]
        names: list[tuple[pd.DataFrame, list[str], Any]] = [(of, [name] * len(of), one) for of, name, one in verdicts]
    else:
        names = [(frame, texts_of(frame, columns.simulator, source), columns)]
    outcomes = {one for one in (columns.repeat, columns.family) if one}
    repeats = []
    for frame, simulators, verdict in names:
        tests = texts_of(frame, columns.test, source)
        family = tests if columns.family is None else texts_of(frame, columns.family, source)
        repeat = np.zeros(len(frame)) if columns.repeat is None else numbers_of(frame, columns.repeat, source)
        failed = verdict.failed
        unread: dict[int, str] = {}
        margin, limit = np.full(len(frame), np.nan), np.full(len(frame), np.nan)
        if verdict.margin is not None:
            margin, limit, unread = _margins(frame, verdict.margin, simulators, source, needed=failed is None)
            outcomes |= {verdict.margin.column, str(verdict.margin.limit)}
        elif failed is None:
            raise OutcomeTableError(f"{source}: name the column that says whether a test failed, as failed or margin")
        if failed is None:
            is_failure = margin > limit
        else:
            is_failure, untold = verdicts_of(frame, failed, source)
            unread |= untold
            rules = [failed] if isinstance(failed, Rule) else failed
            outcomes |= {rules} if isinstance(rules, str) else {rule.column for rule in rules}
        counts = (repeat >= 0.0) & (repeat < MOST_REPEATS) & (repeat == np.floor(repeat))
        of_repeat = f"{columns.repeat} is no whole number from 0 to {MOST_REPEATS}"
        unread |= dict.fromkeys(np.flatnonzero(~counts).tolist(), of_repeat)
        for texts, named in ((simulators, columns.simulator), (tests, columns.test)):
            unread |= {row: f"{', '.join(as_list(named))} is empty" for row, text in enumerate(texts) if not text}
        notes.rows.total += len(frame)
        for row in sorted(unread):
            if notes.rows.strict:
                raise OutcomeTableError(f"{row_of(frame, row, source)}: {unread[row]}")
            of = f" on {simulators[row]}" if columns.simulators is not None else ""
            notes.rows.add(f"{place_of(frame, row)}{of}", unread[row])
        if len(frame) and len(unread) == len(frame):
            raise OutcomeTableError(f"{row_of(frame, 0, source)}: {unread[0]}, and no other row can be read")
        rows = pd.DataFrame(
            {
                "test_id": tests,
                "repeat": np.where(counts, repeat, 0).astype(np.int64),
                "simulator": simulators,
                "failed": is_failure,
                "margin": margin,
                "limit": limit,
                "family": [one or test for one, test in zip(family, tests, strict=True)],
            }
        )
        repeats.append(rows.drop(index=list(unread)))
    return repeats, outcomes


def _driven(frame: pd.DataFrame, verdict: Verdict, source: str) -> pd.DataFrame:
    """Rows of a wide table that a simulator drove: its column of verdicts, or else of margins, is not empty there."""
    name = verdict.failed if isinstance(verdict.failed, str) else None
    if name is None and verdict.failed is None and verdict.margin is not None:
        name = verdict.margin.column
    if name is None:
        return frame
    column_of(frame, name, source)
    return frame[~is_empty(frame[name])]


def _margins(
    frame: pd.DataFrame, margin: Margin, simulators: Sequence[str], source: str, *, needed: bool
) -> tuple[np.ndarray, np.ndarray, dict[int, str]]:
    """Return margins, limits, and row -> why it has none; NaN where they are empty and not needed for the verdict."""
    margins = numbers_of(frame, margin.column, source)
    if isinstance(margin.limit, str):
        if margin.limit not in frame.columns:
            expected = "expected a number, one for each simulator, or a column"
            raise OutcomeTableError(f"{source}: margin.limit is {margin.limit!r:.60}, {expected}")
        limits = numbers_of(frame, margin.limit, source)
    else:
        limits = np.array([_limit(margin.limit, name) if name else np.nan for name in simulators])
    wrong = np.flatnonzero((margins < 0.0) | (limits <= 0.0))
    if len(wrong):
        raise OutcomeTableError(
            f"{row_of(frame, int(wrong[0]), source)}: {margin.column} is negative, or its limit not above 0"
        )
    empty = np.zeros(len(frame), np.bool_) if needed else is_empty(frame[margin.column])
    missing = np.isnan(margins) | np.isnan(limits)
    unread = dict.fromkeys(
        np.flatnonzero(missing & ~empty).tolist(), f"{margin.column} or its limit is not a finite number"
    )
    return np.where(missing, np.nan, margins), np.where(missing, np.nan, limits), unread


def _limit(limit: float | dict[str, float], simulator: str) -> float:
    if isinstance(limit, float):
        return limit
    if simulator not in limit:
        raise OutcomeTableError(f"margin.limit names no limit for {simulator}: expected one for every simulator")
    return limit[simulator]


def write_rows(path: Path, study: Study) -> None:
    """Write the rows of a study as CSV or Parquet, by the suffix."""
    if path.suffix not in (".csv", ".parquet"):
        raise OutcomeTableError(f"{path}: expected a name that ends in .csv or .parquet")
    if path.suffix == ".csv":
        rows = study.rows.assign(**{n: study.rows[n].map(plain_cell) for n in _TEXTS})
        write_whole(path, rows.to_csv(index=False))
        return
    with whole_file(path) as partial:
        pq.write_table(pa.Table.from_pandas(study.rows, preserve_index=False), partial)


def write_study(folder: Path, study: Study) -> Path:
    """Write a study's file."""
    about = {name: getattr(study, name) for name in ("features", "axes", "twin", "car", "car_drawn")}
    about |= {"conditions": study.conditions} if study.conditions else {}
    table = pa.Table.from_pandas(study.rows, preserve_index=False)
    table = table.replace_schema_metadata({KEY: json.dumps(about).encode()})
    with whole_file(folder / STUDY) as partial:
        pq.write_table(table, partial, compression="zstd")
    return folder / STUDY


def read_study(folder: Path) -> Study:
    """Read a study's file; `OutcomeTableError` if it is damaged, or not one."""
    path = folder / STUDY
    table: pa.Table = _read(read_parquet, path)
    frame = table.to_pandas(ignore_metadata=True)
    damaged = OutcomeTableError(f"{path} is no study: make it again with `ds outcomes import`")
    try:
        about = load_json((table.schema.metadata or {})[KEY])
        study = Study(
            rows=frame,
            features=tuple(map(str, about["features"])),
            axes={str(name): float(width) for name, width in about["axes"].items()},
            twin=None if about["twin"] is None else SimulatorName(about["twin"]),
            car=about.get("car"),
            car_drawn=about.get("car_drawn") is True,
            conditions=tuple(map(str, about.get("conditions", ()))),
        )
        kinds = [(frame[one], pd.api.types.is_string_dtype) for one in _TEXTS]
        kinds += [(frame[one], pd.api.types.is_numeric_dtype) for one in {*frame.columns} - {*_TEXTS}]
        numbers = frame[["margin", "limit", *study.features]].to_numpy(np.float64)
        sound = (
            all(is_kind(column) for column, is_kind in kinds),
            frame["failed"].dtype == np.bool_,
            [*LONG, *study.features, *study.conditions] == list(frame.columns),
            set(study.axes) <= set(study.features) and 2 <= len(study.axes) <= 3,
            len(frame) and np.isfinite(numbers[:, 2:]).all() and not np.isinf(numbers).any(),
            all(0.0 < one < np.inf and np.ptp(frame[name]) <= MOST_BINS * one for name, one in study.axes.items()),
            study.simulators and study.twin in (None, *study.simulators),
            study.car is None or (frame["simulator"] == study.car).any(),
        )
        if not all(sound):
            raise damaged
        wrong = (numbers[:, 0] < 0.0) | (numbers[:, 1] <= 0.0) | (frame["repeat"] < 0).to_numpy()
        wrong |= frame[[*_TEXTS]].isna().any(axis=1).to_numpy()
        if wrong.any():
            row = row_of(frame, int(np.flatnonzero(wrong)[0]), str(path))
            raise OutcomeTableError(f"{row}: an id is missing, or margin or repeat below 0, or limit not above 0")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise (error if isinstance(error, OutcomeTableError) else damaged) from None
    return study


def study_of(table: RoadTable) -> Study:
    """Make a study of any table, such as a campaign's, to export it."""
    changed = {name for one in table.conditions for name in one.changed}
    conditions = {column: name for column, name in CONDITIONS.items() if name in changed}
    at = tests, columns = np.nonzero(np.isin(table.states, (State.COMPLETED, State.FAILED)))
    frame = pd.DataFrame(
        {
            "test_id": [table.test_ids[test] for test in tests],
            "repeat": 0,
            "simulator": [table.simulators[column] for column in columns],
            "failed": table.states[at] == State.FAILED,
            "margin": table.lateral[at],
            "limit": table.limits[at],
            "family": table.families[tests].astype(str),
            **dict(zip(table.feature_names, table.features[tests].T, strict=True)),
            **{
                column: np.array([getattr(table.conditions[test], name) for test in tests], np.float64)
                for column, name in conditions.items()
            },
        }
    )
    return Study(
        rows=frame,
        features=table.feature_names,
        axes=axes_of(frame, table.feature_names[:2]),
        twin=table.twin,
        conditions=tuple(conditions),
    )


def axes_of(rows: pd.DataFrame, names: Sequence[str]) -> dict[str, float]:
    """Let features span a map, in about ten bins each, of a width of one digit; 0 and 1 are two bins."""
    return {
        name: 1.0 if rows[name].isin((0.0, 1.0)).all() else max(float(f"{np.ptp(rows[name]) / BINS:.1g}"), 1e-9)
        for name in names
    }
