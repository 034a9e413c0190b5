# SPDX-License-Identifier: Apache-2.0
"""What the columns of a table of outcomes are: the YAML file beside it."""

from __future__ import annotations

from collections.abc import Sequence
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
