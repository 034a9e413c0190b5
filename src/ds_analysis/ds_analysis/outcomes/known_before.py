# SPDX-License-Identifier: Apache-2.0
"""Features of imported tests: columns of numbers, of few words, and with cells that are empty."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from ds_analysis.common.outcome_table import OutcomeTableError
from ds_analysis.outcomes.columns import column_of, is_empty, numbers_of
from ds_base.left_out import LeftOut

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
    is a feature of 0 and 1, `NAME=WORD`.

    The frame has rows of the (rows,) `tests`, and columns with these `names`; None takes all that may be features, and
    are not `used` otherwise: not those that end in one of the `owners`, simulators of a wide table (None: all are known
    to be features), or tell which tests `failed`, where one simulator drove each once. `notes` take what is left out.
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
