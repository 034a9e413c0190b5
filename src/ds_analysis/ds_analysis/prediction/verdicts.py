"""Three answers instead of a number: each test and each cell fails, is safe, or is disputed; a cell may be untested."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, Literal

import numpy as np
from scipy.special import betainc

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import Array, Bools
from ds_analysis.common.table import Column, Table
from ds_analysis.prediction.twin_prediction import TwinPrediction
from ds_orchestrator.search.features import short_name

Verdict = Literal["fails", "safe", "disputed", "untested"]

ERROR_RATE = 0.05
"""Probability with which `fails` or `safe` may be wrong, each; chosen: that of the paper's tests (alpha of 0.05)."""
TOLERATED_RATE = 0.1
"""Failure rate up to which a cell counts as safe, and above which it fails; chosen: one test in ten. A cell whose rate
is near it stays disputed however often it is tested."""
MOST_NEEDED = 10_000
"""Tests beyond which a cell is said to stay disputed; chosen: more than a campaign drives."""
_MOST_CELLS = 2_000
"""Cells up to which untested ones are listed; chosen: a map that fits on a screen."""
_BLOCK = 500
"""Tests whose intervals are computed at once; chosen: 8 MB of draws."""
_SEED = 20
"""Seed of the weights of tests within a cell; any number does."""


@dataclass(frozen=True, kw_only=True)
class TestVerdict:
    """What is predicted of one test.

    Attributes:
        test_id: id of the test.
        cell: its cell; None if it has none.
        probability: probability of failure; the outcome, if the car or twin drove the test.
        interval: 90 % interval of that probability over what is uncertain about the simulator.
        verdict: `fails` if the probability is at least 1 - `ERROR_RATE`, `safe` if at most `ERROR_RATE`, or `disputed`.
        driven: whether the car or twin drove it.
    """

    __test__ = False  # not a test case for pytest

    test_id: str
    cell: tuple[int, ...] | None
    probability: float
    interval: tuple[float, float]
    verdict: Verdict
    driven: bool


@dataclass(frozen=True, kw_only=True)
class CellVerdict:
    """What is predicted of one cell of the feature map.

    Attributes:
        cell: bins.
        tests: number of its tests.
        driven: number of them that the car or twin drove.
        rate: posterior mean of the failure rate of tests like these; None if untested.
        interval: 90 % interval of it.
        verdict: `fails` if the rate is above the tolerated one with a probability of at least 1 - `ERROR_RATE`, `safe`
            if it is below with that probability, `disputed` otherwise, `untested` without tests.
        drives_needed: drives on the car or twin that a disputed cell needs to leave that state, if failures come at the
            present mean rate; None if that is not needed, or more than `MOST_NEEDED`.
    """

    cell: tuple[int, ...]
    tests: int
    driven: int
    rate: float | None = None
    interval: tuple[float, float] | None = None
    verdict: Verdict
    drives_needed: int | None = None


@dataclass(frozen=True, kw_only=True)
class Verdicts:
    """What is predicted of a car, or of a simulator that was never driven.

    Attributes:
        tests: every test with a verdict on a sibling.
        cells: every cell within the bounds of the map.
        features: names of the map's axes.
        tolerated: failure rate up to which a cell counts as safe.
    """

    tests: Sequence[TestVerdict]
    cells: Sequence[CellVerdict]
    features: Sequence[str]
    tolerated: float = TOLERATED_RATE

    @property
    def counts(self) -> dict[str, int]:
        """Verdict -> number of cells."""
        found = Counter(one.verdict for one in self.cells)
        return {name: found[name] for name in ("fails", "safe", "disputed", "untested")}

    @property
    def sentence(self) -> str:
        """What was found, in one line."""
        named = ", ".join(f"{count} {name}" for name, count in self.counts.items())
        return (
            f"{len(self.cells)} cells: {named} (a cell fails if more than {self.tolerated:.0%} of its tests do; "
            f"by the model a call is wrong at most {ERROR_RATE:.0%} of the time)"
        )

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "error_rate": ERROR_RATE,
            "tolerated_rate": self.tolerated,
            "features": list(self.features),
            "cells": [asdict(one) for one in self.cells],
            "tests": [asdict(one) for one in self.tests],
        }


def judge(table: OutcomeTable, prediction: TwinPrediction, *, tolerated: float = TOLERATED_RATE) -> Verdicts:
    """Judge every test and every cell.

    Args:
        table: outcomes of the siblings.
        prediction: of the table's tests.
        tolerated: failure rate up to which a cell counts as safe.
    """
    used = [int(k) for k in np.flatnonzero(np.any([table.known(name) for name in table.siblings], axis=0))]
    driven = {drive.row for drive in prediction.drives}
    probabilities = prediction.probabilities()
    draws = prediction.draws(rows=np.array(used))
    blocks = np.array_split(draws, max(1, len(used) // _BLOCK), axis=1)
    low, high = np.concatenate([np.quantile(block, (0.05, 0.95), axis=0) for block in blocks], axis=1)
    tests = [
        TestVerdict(
            test_id=table.test_ids[row],
            cell=table.cells[row],
            probability=float(probabilities[row]),
            interval=(float(low[k]), float(high[k])),
            verdict=verdict_of(float(probabilities[row])),
            driven=row in driven,
        )
        for k, row in enumerate(used)
    ]
    members: dict[tuple[int, ...], list[int]] = {}
    for k, row in enumerate(used):
        cell = table.cells[row]
        if cell is not None:
            members.setdefault(cell, []).append(k)
    rng = np.random.default_rng(_SEED)
    alike = prediction.draws(rows=np.array(used), outcomes=False) if driven else draws
    cells = []
    for cell in _bounds(members):
        columns = members.get(cell, [])
        outcomes = draws[:, [k for k in columns if used[k] in driven]]
        cells.append(_judge_cell(cell, alike[:, columns], outcomes, tolerated, rng))
    return Verdicts(tests=tests, cells=cells, features=table.axes, tolerated=tolerated)


def verdict_of(probability: float) -> Verdict:
    """Call a test, or a cell, by the probability that it fails."""
    if probability >= 1.0 - ERROR_RATE:
        return "fails"
    return "safe" if probability <= ERROR_RATE else "disputed"


def called(probabilities: Array) -> tuple[Bools, Bools]:
    """(tests,) which tests are called safe, and which failing; the others are disputed."""
    return probabilities <= ERROR_RATE, probabilities >= 1.0 - ERROR_RATE


def _bounds(cells: Sequence[tuple[int, ...]] | dict[tuple[int, ...], list[int]]) -> list[tuple[int, ...]]:
    """Every cell between the smallest and the largest bins; where these are too many, those with tests."""
    if not cells:
        return []
    axes = [range(min(bins), max(bins) + 1) for bins in zip(*cells, strict=True)]
    return list(product(*axes)) if math.prod(map(len, axes)) <= _MOST_CELLS else sorted(cells)


def _judge_cell(
    cell: tuple[int, ...], draws: Array, outcomes: Array, tolerated: float, rng: np.random.Generator
) -> CellVerdict:
    """Judge a cell from draws (draws, tests) of the probabilities that tests like its own fail, and from its drives.

    Tests of a cell are a sample of what could be tested there: their weights are drawn, too (Bayesian bootstrap, Rubin,
    Ann. Stat. 1981). A drive's outcome (draws, drives) counts as one more test: one drive alone decides no cell.
    """
    tests = draws.shape[1]
    if not tests:
        return CellVerdict(cell=cell, tests=0, driven=0, verdict="untested")
    known = np.hstack((draws, outcomes))
    weights = rng.standard_exponential(known.shape)
    rates = (weights * known).sum(axis=1) / weights.sum(axis=1)
    above = float((rates > tolerated).mean())
    verdict = verdict_of(above)
    low, high = np.quantile(rates, (0.05, 0.95))
    mean = float(rates.mean())
    # The Beta distribution may be decided where the draws are not.
    needed = drives_needed(mean, float(rates.var()), tolerated) if verdict == "disputed" else None
    return CellVerdict(
        cell=cell,
        tests=tests,
        driven=outcomes.shape[1],
        rate=mean,
        interval=(float(low), float(high)),
        verdict=verdict,
        drives_needed=None if needed is None else max(needed, 1),
    )


def drives_needed(mean: float, variance: float, tolerated: float) -> int | None:
    """Count the further tests after which a failure rate is surely above or below the tolerated one.

    The rate's posterior is taken as the Beta distribution with the same mean and variance, and tests are taken to fail
    at the mean rate, so that their number only narrows it.

    Args:
        mean: posterior mean of the rate.
        variance: its posterior variance.
        tolerated: rate to compare with.

    Returns:
        Number of tests, or None if `MOST_NEEDED` are not enough.
    """
    mean = min(max(mean, 1e-6), 1.0 - 1e-6)
    pseudo = max(mean * (1.0 - mean) / max(variance, 1e-12) - 1.0, 1e-6)
    total = pseudo + np.arange(MOST_NEEDED + 1)
    below = betainc(mean * total, (1.0 - mean) * total, tolerated)
    decided = np.flatnonzero(np.logical_or(*called(below)))
    return int(decided[0]) if len(decided) else None


def cell_table(found: Verdicts, labels: Sequence[Sequence[str]]) -> Table:
    """Tabulate the cells that have tests.

    Args:
        found: verdicts.
        labels: of every cell of `found`, one per axis.
    """
    return Table(
        name="cell_verdicts",
        title="Predicted failures per cell",
        columns=[
            *(Column(short_name(name)) for name in found.features),
            Column("tests", "count"), Column("driven", "count"),
            Column("failure rate", "number"), Column("90 %", "number"), Column("verdict"),
            Column("drives needed", "count"),
        ],
        rows=[
            (*label, one.tests, one.driven, one.rate, one.interval, one.verdict, one.drives_needed)
            for one, label in zip(found.cells, labels, strict=True)
            if one.tests
        ],
        notes=[found.sentence],
    )  # fmt: skip
