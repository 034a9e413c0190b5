# SPDX-License-Identifier: Apache-2.0
"""What the columns of a table of outcomes are: the YAML file beside it, and which are features."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field, ValidationError, model_validator

from ds_analysis.common.outcome_table import OutcomeTableError
from ds_analysis.common.statistics import Bools
from ds_base.bounded_file import FileError
from ds_base.bounded_yaml import read_yaml
from ds_base.config_errors import Keys
from ds_base.left_out import LeftOut
from ds_sim.registry import SimulatorName

GUIDE = "docs/outcomes.md"
WORDS = {
    True: {"true", "1", "1.0", "yes", "fail", "failed", "failure", "out_of_bounds", "unsafe"},
    False: {"false", "0", "0.0", "no", "pass", "passed", "completed", "success", "safe"},
}
"""Whether a test failed -> how a table says so, in lower case."""
NO_VERDICT = {"error", "invalid", "skipped", "cancelled", "not_run"}
"""Words of tests that did not end."""
MOST_EMPTY = 0.1
"""Share of rows without a verdict up to which the others may all say the same; chosen: a column of events has more."""
_SHOWN = 6


class Rule(Keys, allow_inf_nan=False):
    """Rows with this or another value of a column ("" is an empty cell), or with a larger or smaller number."""

    column: str
    is_: str | float | bool | None = Field(default=None, alias="is")
    is_not: str | float | bool | None = None
    above: float | None = None
    below: float | None = None

    @model_validator(mode="after")
    def _makes_sense(self) -> Rule:
        if [self.is_, self.is_not, self.above, self.below].count(None) != 3:
            raise ValueError("expected one of is, is_not, above and below")
        return self

    def holds(self, frame: pd.DataFrame, source: str) -> tuple[Bools, Bools]:
        """(rows,) where it holds, and where nobody can tell, as the cell is empty or no number."""
        column = column_of(frame, self.column, source)
        empty = is_empty(frame[self.column])
        if self.above is not None or self.below is not None:
            numbers = numbers_of(frame, self.column, source)
            failed = numbers > self.above if self.above is not None else numbers < self.below
            return np.asarray(failed, np.bool_), np.isnan(numbers)
        wanted = self.is_ if self.is_ is not None else self.is_not
        if wanted == "":
            return empty if self.is_ is not None else ~empty, np.zeros(len(frame), np.bool_)
        same = np.array([word_of(one) == word_of(wanted) for one in column], np.bool_)
        if len(same) and not same.any():
            examples = ", ".join(sorted({str(one) for one in column})[:_SHOWN])
            raise OutcomeTableError(f"{source}: {self.column} is never {wanted!r:.60}, but {examples:.150}")
        return same if self.is_ is not None else ~same, empty


class Margin(Keys, allow_inf_nan=False):
    """Column with how close a run came to its limit, beyond which it failed."""

    # Its name; at least 0, such as the largest distance from the lane's centre; empty where only the verdict is known.
    column: str
    # A number, one for each simulator, or the name of a column.
    limit: Annotated[float, Field(gt=0.0)] | dict[str, Annotated[float, Field(gt=0.0)]] | str


Failed = str | list[Rule] | Rule
"""Column that says whether a test failed, or rules of which one has to hold."""


class Verdict(Keys, allow_inf_nan=False):
    """How one simulator's columns of a wide table say whether a test failed."""

    failed: Failed | None = None
    margin: Margin | None = None


class Columns(Keys, allow_inf_nan=False):
    """Content of the YAML file; left out, columns have the names that `ds outcomes export` gives, if they exist."""

    test: str | list[str] = "test_id"  # column, or columns, with the id of the test
    simulator: str | list[str] = "simulator"  # column, or columns, that name the simulator
    # Of a wide table, with one row a test: simulator -> its columns; instead of `simulator`.
    simulators: dict[SimulatorName, Verdict] | None = None
    failed: Failed | None = None  # column or rules; see `Failed`
    margin: Margin | None = None  # instead of, or beside, `failed`
    repeat: str | None = None  # column with the number of the repetition
    # Column of what tests have in common that are not independent, such as the road that they change.
    family: str | None = None
    # Columns that are known before a test is driven, of numbers or of few words; all others if left out.
    features: list[str] | None = None
    where: list[Rule] = []  # rows to read
    # Axes of the map, feature -> width of a bin; the first two features in ten bins each if left out.
    map: Annotated[dict[str, Annotated[float, Field(gt=0.0)]], Field(min_length=2, max_length=3)] | None = None
    twin: SimulatorName | None = None  # simulator that the others are to predict
    car: str | None = None  # real car whose rows are its drives: they update the prediction, and are not a simulator's
    car_drawn: bool = False  # whether the car's tests were drawn at random from all, so that they certify something

    def filled(self, names: Sequence[str]) -> Columns:
        """Return the same, with columns of the usual names where nothing was said."""
        usual: dict[str, Any] = {
            name: name for name in ("repeat", "family") if getattr(self, name) is None and name in names
        }
        if self.simulators is None and self.margin is None and {"margin", "limit"} <= set(names):
            usual["margin"] = Margin(column="margin", limit="limit")
        if self.simulators is None and self.failed is None and "failed" in names:
            usual["failed"] = "failed"
        return self.model_copy(update=usual)


def read_columns(path: Path) -> Columns:
    """Read the YAML file; one line of an `OutcomeTableError` says which key is wrong, and what is expected."""
    try:
        return Columns.model_validate(read_yaml(path))
    except OSError as error:
        raise OutcomeTableError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except FileError as error:
        raise OutcomeTableError(f"{path}: not YAML ({error})") from None
    except ValidationError as error:
        first = error.errors()[0]
        named = (str(part) for part in first["loc"])  # pydantic adds the member type of a union
        place = ".".join(part for part in named if not part.startswith(("Rule", "list[", "str", "dict")))
        keys = f" (keys: {', '.join(Columns.model_fields)})" if first["type"] == "extra_forbidden" else ""
        text = " ".join(str(first["msg"]).removeprefix("Value error, ").split())
        raise OutcomeTableError(f"{path}: {place or 'top level'}: {text}{keys}: see {GUIDE}") from None


def column_of(frame: pd.DataFrame, name: str, source: str) -> list[Any]:
    """Return a column."""
    if name not in frame.columns:
        names = [str(one) for one in frame.columns]
        more = ", ..." if len(names) > 3 * _SHOWN else ""
        raise OutcomeTableError(
            f"{source} has no column {name!r}, but {', '.join(names[: 3 * _SHOWN])}{more}: say in --columns which is "
            "what"
        )
    return frame[name].tolist()


def is_empty(column: pd.Series[Any]) -> Bools:
    """(rows,) where a column has no value, or only blanks."""
    return np.asarray(column.isna() | (column.astype(str).str.strip() == ""), np.bool_)


def texts_of(frame: pd.DataFrame, names: str | list[str], source: str) -> list[str]:
    """Return a column as text, or several, joined by hyphens; "" where one of them is empty."""
    for name in as_list(names):
        column_of(frame, name, source)
    empty = np.any([is_empty(frame[name]) for name in as_list(names)], axis=0)
    parts = [[text_of(one) for one in frame[name].tolist()] for name in as_list(names)]
    return ["" if no else "-".join(one) for no, one in zip(empty, zip(*parts, strict=True), strict=True)]


def as_list(names: str | list[str]) -> list[str]:
    """Return one name, or several, as a list."""
    return [names] if isinstance(names, str) else names


def numbers_of(frame: pd.DataFrame, name: str, source: str) -> np.ndarray:
    """Return a column of finite numbers; NaN where there is none."""
    column_of(frame, name, source)
    numbers = pd.to_numeric(frame[name], errors="coerce").to_numpy(np.float64, na_value=np.nan)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def verdicts_of(frame: pd.DataFrame, failed: Failed, source: str) -> tuple[Bools, dict[int, str]]:
    """(rows,) whether each test failed, and row -> why it does not say so."""
    strange: set[int] = set()
    if isinstance(failed, str):
        words = [word_of(one) for one in column_of(frame, failed, source)]
        empty, vocabulary = is_empty(frame[failed]), WORDS[True] | WORDS[False]
        reasons = {
            row: f"{failed} is empty" if empty[row] else f"{failed} is {word!r:.60}"
            for row, word in enumerate(words)
            if empty[row] or word not in vocabulary
        }
        strange = {row for row in reasons if not empty[row] and words[row] not in NO_VERDICT}
        positive = np.array([word in WORDS[True] for word in words], np.bool_)
    else:
        rules = failed if isinstance(failed, list) else [failed]
        held, unknown = map(np.array, zip(*(rule.holds(frame, source) for rule in rules), strict=True))
        positive = (held & ~unknown).any(axis=0)
        untold = ~positive & unknown.any(axis=0)
        reasons = {
            int(row): f"{rules[int(np.argmax(unknown[:, row]))].column} is empty or no number"
            for row in np.flatnonzero(untold)
        }
    kept = np.delete(positive, list(reasons))
    if reasons and (strange or len(reasons) > MOST_EMPTY * len(frame)) and (kept.all() or not kept.any()):
        row = min(strange or reasons)
        expected = f"expected true or false, 1 or 0, failed or completed, or rules: {GUIDE}"
        raise OutcomeTableError(
            f"{row_of(frame, row, source)}: {reasons[row]}, {expected}; without such rows no verdict differs"
        )
    return positive, reasons


def row_of(frame: pd.DataFrame, row: int, source: str) -> str:
    """Name a row of a table, by its line if the file has lines, and show its first values."""
    shown = ", ".join(f"{name}={frame.iloc[row][name]}" for name in list(frame.columns)[:_SHOWN])
    return f"{source}, {place_of(frame, row)} ({shown:.150})"


def place_of(frame: pd.DataFrame, row: int) -> str:
    """Name a row by its line if the file has lines."""
    return f"line {frame.index[row]}" if frame.index.name == "line" else f"row {row + 1}"


def text_of(value: Any) -> str:
    """Text of a cell; a whole number without a decimal point, as pandas adds one where another cell is empty."""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value)


def word_of(value: Any) -> str:
    """Word of a cell, in lower case."""
    return text_of(value).strip().lower()


MOST_LEVELS = 12
"""Words of a column up to which each becomes a feature; chosen: weathers and towns have fewer, remarks have more."""
MOSTLY = 0.9
"""Share of a column's cells that have to be numbers for the others to be missing ones; chosen."""
IDENTIFIER = re.compile(r"(^|[\W_])(id|index|seed|uuid|hash|unnamed: \d+)$", re.IGNORECASE)
AFTERWARDS = re.compile(
    r"(^|[\W_])(status|outcome|result|verdict|reason|message|error|comment|notes?|description|xte|cte|"
    r"(duration|elapsed|(wall|sim(ulat(ion|ed))?|run|execution|driving|lap)_?time)([\W_](s|ms|sec|seconds|min))?|"
    r"(score|fitness|collisions?)(_.*)?)$",
    re.IGNORECASE,
)
"""Names of columns that are written after a drive."""
MEASURED = re.compile(
    r"(^|[\W_])(time|t|seconds|frames?|steps?|ticks?|final|end|last|stop|driven|travell?ed|covered|reached|progress|"
    r"completed|completion|damage|impact|laps?)([\W_]|$)",
    re.IGNORECASE,
)
"""Names of columns that may be measured in a drive, or be set before it, such as a time of day."""
FEWEST = 5
"""Failing and passing tests each from which a column that tells them apart exactly is no chance; chosen."""


@dataclass
class ImportNotes:
    """Rows that cannot be read, columns that are no features, and a line for each feature with words or gaps."""

    rows: LeftOut = field(default_factory=lambda: LeftOut("rows", strict=True))
    columns: LeftOut = field(default_factory=lambda: LeftOut("columns"))
    features: list[str] = field(default_factory=list)


def features_of(
    frame: pd.DataFrame,
    tests: Sequence[str],
    names: Sequence[str] | None,
    used: set[str],
    notes: ImportNotes,
    source: str,
    *,
    owners: Sequence[str] | None = (),
    failed: pd.Series[bool] | None = None,
) -> pd.DataFrame:
    """Return the features of each test, a row for each.

    A missing number is the median of the other tests, and 1 in a further feature, `NAME missing`. Each word of a column
    is a feature of 0 and 1, `NAME=WORD`. The frame has rows of the (rows,) `tests`. Without `names` of columns, all are
    taken that may be features and are not `used` otherwise: not those that end in one of the `owners`, simulators of a
    wide table (None: all are features), or tell which tests `failed`, where one simulator drove each once.
    """
    columns: dict[str, pd.Series[Any]] = {}
    for name in names if names is not None else [one for one in frame.columns if one not in used]:
        column_of(frame, name, source)
        values, is_number = _values(frame[name], numbers_of(frame, name, source))
        reason = _varies(values, tests, is_number)
        of_test = values.groupby(pd.Index(tests), sort=False).first()
        levels = [] if is_number else sorted(of_test.dropna().unique())
        if not reason and not is_number and len(levels) > MOST_LEVELS:
            reason = f"has {len(levels)} different words, expected numbers or at most {MOST_LEVELS} words"
        if reason and names is not None:
            raise OutcomeTableError(f"{source}: {name} {reason}: it is no feature, leave it out of features")
        if names is None:
            if of_test.nunique(dropna=False) < 2:
                continue
            notes.columns.total += 1
            reason = reason or ("" if owners is None else _unlike(name, levels, of_test, owners))
            told = "" if reason or failed is None else _tells(of_test, failed.reindex(of_test.index), is_number)
            # A number may do so by chance of the tests, such as the sharpest bend; its name decides.
            may_be_known = is_number and not of_test.isna().any() and not MEASURED.search(name)
            if reason := reason or ("" if may_be_known else told):
                notes.columns.add(name, reason)
                continue
            if told:
                notes.features.append(f"{name} {told}: leave it out if it is known only after a drive")
        gaps = of_test.isna()
        if gaps.any() and notes.rows.strict:
            raise OutcomeTableError(f"{source}: {name} is no finite number, or empty, for test {gaps.idxmax()}")
        if is_number:
            columns[name] = of_test.astype(np.float64).fillna(of_test.median())
        else:
            columns |= {f"{name}={level}": (of_test == level).astype(np.float64) for level in levels}
            notes.features.append(f"{name}: a feature of 0 and 1 for each of {', '.join(levels)}")
        if gaps.any():
            columns[f"{name} missing"] = gaps.astype(np.float64)
            median = f", which count as the median, {of_test.median():.4g}" if is_number else ""
            notes.features.append(f"{name} missing: 1 for the {gaps.sum()} of {len(gaps)} tests without it{median}")
    return pd.DataFrame(columns)


def _values(column: pd.Series[Any], numbers: np.ndarray) -> tuple[pd.Series[Any], bool]:
    """Values of a column, NaN where there is none, and whether they are numbers rather than words."""
    cells = ~is_empty(column)
    is_time = column.dtype.kind in "mM"
    if not is_time and np.isfinite(numbers).sum() >= MOSTLY * cells.sum():
        return pd.Series(numbers), True
    words: pd.Series[Any] = column.astype(str).str.strip().where(cells)
    return words.set_axis(range(len(words))), False


def _varies(values: pd.Series[Any], tests: Sequence[str], is_number: bool) -> str:
    """Why a column is known only after a drive; empty if it may be a feature."""
    of_test = values.groupby(pd.Index(tests))
    if is_number:
        spread = of_test.max() - of_test.min()
        differing = spread[spread > 1e-9 * of_test.max().abs()].index
    else:
        counts = of_test.nunique()
        differing = counts[counts > 1].index
    return f"differs between drives of {len(differing)} tests, as {differing[0]}" if len(differing) else ""


def _tells(of_test: pd.Series[Any], failed: pd.Series[bool], is_number: bool) -> str:
    """How a column says exactly which tests failed; empty if it does not, or these are too few to say."""
    if min(failed.sum(), (~failed).sum()) < FEWEST:
        return ""
    gaps = of_test.isna()
    if gaps.equals(failed) or gaps.equals(~failed):
        return f"is filled in for exactly the tests that {'pass' if gaps.equals(failed) else 'fail'}"
    if not is_number:
        pure = failed.groupby(of_test).nunique().max() == 1 and failed.groupby(of_test).size().min() >= FEWEST
        return "has words that say exactly which tests fail" if pure and not gaps.any() else ""
    low, high = sorted((of_test[failed], of_test[~failed]), key=pd.Series.min)
    return "tells failing tests from others exactly" if low.max() < high.min() else ""


def _unlike(name: str, levels: Sequence[str], of_test: pd.Series[Any], owners: Sequence[str]) -> str:
    """Why a column that nobody named as a feature is none; empty if it is one."""
    if IDENTIFIER.search(name):
        return "is an identifier by its name"
    if AFTERWARDS.search(name):
        return "is written after a drive, by its name"
    if len(levels) > len(of_test) / 2:
        return "names single tests"
    owner = [one for one in owners if re.search(rf"(^|[\W_]){re.escape(one)}$", name, re.IGNORECASE)]
    return f"belongs to {owner[0]}" if owner else ""
