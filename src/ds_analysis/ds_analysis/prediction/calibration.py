"""Forecasts of cells' failure rates, and whether calls hold on the siblings themselves: each plays the car in turn.

A campaign without a twin cannot tell how well its prediction of a car does, but it can tell how well the same model
would have predicted each of its simulators. Where these fail in ways of their own, it is wrong more often than it says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import RESAMPLES, Array, Bools
from ds_analysis.common.table import Column, Table
from ds_analysis.common.weighted_scores import family_weights, interval_of, mean_of
from ds_analysis.prediction.margins import FEWEST_TESTS
from ds_analysis.prediction.twin_prediction import TwinPrediction, predict_twin
from ds_analysis.prediction.verdicts import ERROR_RATE, called

COVERAGE = 0.9
"""Nominal coverage of the intervals of a cell's failure rate."""
SEED = 19
"""Seed of the drawn outcomes; any number does."""


@dataclass(frozen=True, kw_only=True)
class CellForecast:
    """Failure rate that is predicted for a cell's tests, and the one that was found.

    Attributes:
        cell: cell of the feature map.
        tests: number of its tests.
        mean: mean of the predicted rate.
        interval: 90 % interval of the rate that these tests will have; a rate of few tests takes few values, so that it
            usually holds more than 90 %.
        observed: share of the tests that failed; None if they were not driven.
        rank: share of the drawn rates below the observed one, equal ones split at random: uniform on [0, 1] if the
            prediction is calibrated, however few tests a cell has (randomised probability integral transform).
    """

    cell: tuple[int, ...]
    tests: int
    mean: float
    interval: tuple[float, float]
    observed: float | None
    rank: float | None

    @property
    def holds(self) -> bool | None:
        """Whether the interval holds the observed rate; None if there is none."""
        return None if self.observed is None else self.interval[0] <= self.observed <= self.interval[1]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {**asdict(self), "holds": self.holds}


def share_held(ranks: Sequence[float]) -> float | None:
    """Share of randomised ranks, one a cell, that lie inside of the interval's; None without any."""
    if not ranks:
        return None
    inside = np.array(ranks)
    return float(((inside >= (1 - COVERAGE) / 2) & (inside <= (1 + COVERAGE) / 2)).mean())


def forecast_cells(
    table: OutcomeTable, prediction: TwinPrediction, *, fewest: int = 1, seed: int = SEED
) -> list[CellForecast]:
    """Forecast the failure rate of the tests of every cell.

    Args:
        table: outcomes.
        prediction: of the table's tests.
        fewest: tests that a cell must have.
        seed: seed of the drawn outcomes.
    """
    known = None if table.twin is None else table.known(table.twin)
    members: dict[tuple[int, ...], list[int]] = {}
    for k, cell in enumerate(table.cells):
        if cell is not None and table.on_siblings[k] and (known is None or known[k]):
            members.setdefault(cell, []).append(k)
    rng = np.random.default_rng(seed)
    found = []
    for cell in sorted(cell for cell, rows in members.items() if len(rows) >= fewest):
        rows = np.array(members[cell])
        probabilities = prediction.draws(rows=rows)
        failures = (rng.random(probabilities.shape) < probabilities).sum(axis=1)
        low, high = np.quantile(failures, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2], method="inverted_cdf")
        observed = None if table.twin is None else int(table.failed(table.twin)[rows].sum())
        found.append(
            CellForecast(
                cell=cell,
                tests=len(rows),
                mean=float(probabilities.mean()),
                interval=(float(low / len(rows)), float(high / len(rows))),
                observed=None if observed is None else observed / len(rows),
                rank=None
                if observed is None
                else float((failures < observed).mean() + rng.random() * (failures == observed).mean()),
            )
        )
    return found


FEWEST_SIBLINGS = 3
"""Siblings that a check takes; chosen: two that predict the third, as one has no spread."""
_RESAMPLING_SEED = 23
"""Seed of the resamples; any number does."""


@dataclass(frozen=True, kw_only=True)
class Calls:
    """Tests that are called safe, or failing.

    Attributes:
        count: number of tests so called, over all siblings.
        wrong: those of them that do otherwise.
        interval: 95 % interval of the share of wrong ones over families of tests; None if it has no width.
    """

    count: int
    wrong: int
    interval: tuple[float, float] | None

    @property
    def too_many(self) -> bool:
        """Whether more are wrong than `ERROR_RATE`, beyond chance."""
        return self.interval is not None and self.interval[0] > ERROR_RATE


@dataclass(frozen=True, kw_only=True)
class InTurn:
    """How a sibling was predicted from the others.

    Attributes:
        simulator: its name.
        tests: number of tests that all siblings drove.
        failures: tests that fail on it.
        safe: tests called safe, and those of them that fail.
        failing: tests called failing, and those of them that do not.
        cells: number of its cells.
        held: share of the cells whose 90 % interval holds the failure rate, by randomised ranks.
    """

    simulator: str
    tests: int
    failures: int
    safe: tuple[int, int]
    failing: tuple[int, int]
    cells: int
    held: float | None


@dataclass(frozen=True, kw_only=True)
class SelfCheck:
    """Each sibling in turn, and the calls of all of them together."""

    siblings: Sequence[InTurn]
    safe: Calls
    failing: Calls

    @property
    def sentence(self) -> str:
        """What was found, for a terminal and a page."""
        if not self.siblings:
            needed = f"{FEWEST_SIBLINGS} of them with {FEWEST_TESTS} common tests"
            return f"Calls cannot be checked on the siblings: that takes {needed}"
        if not self.safe.count and not self.failing.count:
            return "Checked on the siblings, each in turn playing the car: no test is called safe or failing"
        named = ", ".join((_described(self.safe, "safe", "fail"), _described(self.failing, "failing", "do not")))
        return f"Checked on the siblings, each in turn playing the car: {named} (stated: at most {ERROR_RATE:.0%})"

    @property
    def warning(self) -> str:
        """What not to rely on, or ""."""
        bad = [name for name, calls in (("safe", self.safe), ("fails", self.failing)) if calls.too_many]
        return (
            f"do not rely on {' or '.join(bad)}: these simulators fail in ways of their own, which the others do not "
            "predict, and a car may"
            if bad
            else ""
        )

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {**asdict(self), "warning": self.warning}

    def table(self) -> Table:
        """Tabulate the siblings."""
        return Table(
            name="self_check",
            title="Checked on the siblings: each in turn plays the car, predicted from the others",
            columns=[
                Column("sibling"), Column("tests", "count"), Column("fails", "count"), Column("called safe", "count"),
                Column("of them fail", "count"), Column("called failing", "count"), Column("of them do not", "count"),
                Column("cells", "count"), Column(f"held by {COVERAGE:.0%} intervals", "number"),
            ],
            rows=[
                (one.simulator, one.tests, one.failures, *one.safe, *one.failing, one.cells, one.held)
                for one in self.siblings
            ],
            notes=[f"{self.sentence}."],
        )  # fmt: skip


def check_in_turn(table: OutcomeTable) -> SelfCheck:
    """Let each sibling in turn play the car; a twin's outcomes are not looked at.

    Args:
        table: outcomes; tests without a verdict on one of the siblings are left out.
    """
    known = table.with_twin(None).select(table.on_siblings)
    if len(known.siblings) < FEWEST_SIBLINGS or len(known) < FEWEST_TESTS:
        none = Calls(count=0, wrong=0, interval=None)
        return SelfCheck(siblings=(), safe=none, failing=none)
    found, safe, failing, failed = [], [], [], []
    for name in known.siblings:
        turned = known.with_twin(name)
        prediction = predict_twin(turned)
        (low, high), fails = called(prediction.probabilities()), turned.failed(name)
        ranks = [one.rank for one in forecast_cells(turned, prediction) if one.rank is not None]
        found.append(
            InTurn(
                simulator=name,
                tests=len(known),
                failures=int(fails.sum()),
                safe=(int(low.sum()), int((low & fails).sum())),
                failing=(int(high.sum()), int((high & ~fails).sum())),
                cells=len(ranks),
                held=share_held(ranks),
            )
        )
        safe.append(low)
        failing.append(high)
        failed.append(fails)
    weights = family_weights(np.tile(known.families, len(known.siblings)), RESAMPLES, _RESAMPLING_SEED)
    wrong = np.concatenate(failed)
    return SelfCheck(
        siblings=tuple(found),
        safe=_calls(np.concatenate(safe), wrong, weights),
        failing=_calls(np.concatenate(failing), ~wrong, weights),
    )


def _calls(rows: Bools, wrong: Bools, weights: Array) -> Calls:
    return Calls(
        count=int(rows.sum()),
        wrong=int((rows & wrong).sum()),
        interval=interval_of(mean_of(wrong[rows].astype(np.float64), weights[:, rows])) if rows.any() else None,
    )


def _described(calls: Calls, name: str, otherwise: str) -> str:
    tests = f"{calls.count} test{'' if calls.count == 1 else 's'} called {name}"
    if not calls.wrong or calls.interval is None:
        return f"of {tests} {calls.wrong} {otherwise}"
    low, high = (f"{100 * end:.0f}" for end in calls.interval)
    share = f"{100 * calls.wrong / calls.count:.0f} %, 95 % interval {low} to {high} %"
    return f"of {tests} {calls.wrong} {otherwise} ({share})"
