# SPDX-License-Identifier: Apache-2.0
"""Three answers instead of a number: each test and each cell fails, is safe, or is disputed; a cell may be untested."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, Literal

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import Array
from ds_analysis.prediction.mixture import Prediction
from ds_base.table import Column, Table, styled
from ds_orchestrator.search.features import Feature

Verdict = Literal["fails", "safe", "disputed", "untested"]

ERROR_RATE = 0.05
"""Probability with which `fails` or `safe` may be wrong, each; chosen: that of the paper's tests (alpha of 0.05)."""
TOLERATED_RATE = 0.1
"""Failure rate up to which a cell counts as safe, and above which it fails; chosen: one test in ten."""
_MOST_CELLS = 2_000
"""Cells up to which untested ones are listed; chosen: a map that fits on a screen."""
_SEED = 20
"""Seed of the weights of tests within a cell; any number does."""


@dataclass(frozen=True, kw_only=True)
class TestVerdict:
    """What is predicted of one test.

    Attributes:
        probability: probability of failure; the outcome, if the car drove the test.
        verdict: `fails` if the probability is at least 1 - `ERROR_RATE`, `safe` if at most `ERROR_RATE`, or `disputed`.
    """

    __test__ = False  # not a test case for pytest

    test_id: str
    cell: tuple[int, ...] | None
    probability: float
    verdict: Verdict
    driven: bool


@dataclass(frozen=True, kw_only=True)
class CellVerdict:
    """What is predicted of one cell of the feature map.

    Attributes:
        rate: posterior mean of the failure rate of tests like these; None if untested.
        interval: 90% interval of it.
        verdict: `fails` or `safe` if the rate is above or below the tolerated one with a probability of at least
            1 - `ERROR_RATE`, `disputed` otherwise, `untested` without tests.
    """

    cell: tuple[int, ...]
    tests: int
    driven: int
    rate: float | None = None
    interval: tuple[float, float] | None = None
    verdict: Verdict = "untested"


@dataclass(frozen=True, kw_only=True)
class Verdicts:
    """What is predicted of a car, or of a simulator that was never driven.

    Attributes:
        tests: every test with a verdict on a sibling or on the car.
        cells: every cell within the bounds of the map.
    """

    tests: Sequence[TestVerdict]
    cells: Sequence[CellVerdict]
    features: Sequence[Feature]
    tolerated: float = TOLERATED_RATE

    @property
    def counts(self) -> Mapping[str, int]:
        """Verdict -> number of cells."""
        counts = Counter(one.verdict for one in self.cells)
        return {name: counts[name] for name in ("fails", "safe", "disputed", "untested")}

    @property
    def undriven(self) -> Sequence[TestVerdict]:
        """Tests that the car has not driven."""
        return [one for one in self.tests if not one.driven]

    def labels(self, cell: tuple[int, ...]) -> list[str]:
        """Format the bins of a cell, one text per axis."""
        return [axis.label(bin_) for axis, bin_ in zip(self.features, cell, strict=True)]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "error_rate": ERROR_RATE,
            "tolerated_rate": self.tolerated,
            "features": [feature.axis for feature in self.features],
            "cells": [asdict(one) for one in self.cells],
            "tests": [asdict(one) for one in self.tests],
        }


def judge(table: OutcomeTable, prediction: Prediction, *, tolerated: float = TOLERATED_RATE) -> Verdicts:
    """Judge every test and every cell, which is safe up to the tolerated failure rate."""
    driven = {drive.row for drive in prediction.drives}
    judged = table.on_a_sibling
    judged[list(driven)] = True
    used = np.flatnonzero(judged)
    tests = [
        TestVerdict(
            test_id=table.test_ids[row],
            cell=table.cells[row],
            probability=float(probability),
            verdict=verdict_of(float(probability)),
            driven=row in driven,
        )
        for row, probability in zip(map(int, used), prediction.probabilities(used), strict=True)
    ]
    members: dict[tuple[int, ...], list[int]] = {}
    for k, one in enumerate(tests):
        if one.cell is not None:
            members.setdefault(one.cell, []).append(k)
    rng = np.random.default_rng(_SEED)
    draws = prediction.draws(used, outcomes=False)
    cells = []
    for cell in _bounds(members):
        columns = members.get(cell, [])
        outcomes = np.array([tests[k].probability for k in columns if tests[k].driven])
        cells.append(_judge_cell(cell, draws[:, columns], outcomes, tolerated, rng))
    return Verdicts(tests=tests, cells=cells, features=table.axes, tolerated=tolerated)


def verdict_of(probability: float) -> Verdict:
    """Call a test, or a cell, by the probability that it fails."""
    if probability >= 1.0 - ERROR_RATE:
        return "fails"
    return "safe" if probability <= ERROR_RATE else "disputed"


def _bounds(cells: Mapping[tuple[int, ...], Sequence[int]]) -> list[tuple[int, ...]]:
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
    Ann. Stat. 1981). A drive's outcome counts as one more test: one drive alone decides no cell.
    """
    tests = draws.shape[1]
    if not tests:
        return CellVerdict(cell=cell, tests=0, driven=0)
    states = np.hstack((draws, np.repeat(outcomes[None], len(draws), axis=0)))
    weights = rng.standard_exponential(states.shape)
    rates = (weights * states).sum(axis=1) / weights.sum(axis=1)
    low, high = np.quantile(rates, (0.05, 0.95))
    return CellVerdict(
        cell=cell,
        tests=tests,
        driven=len(outcomes),
        rate=float(rates.mean()),
        interval=(float(low), float(high)),
        verdict=verdict_of(float((rates > tolerated).mean())),
    )


def cell_table(verdicts: Verdicts) -> Table:
    """Tabulate the cells that have tests."""
    return Table(
        name="cell_verdicts",
        title="Predicted failures per cell",
        columns=[
            *(Column(feature.name) for feature in verdicts.features),
            *styled("count", "tests", "driven"),
            *styled("number", "failure rate", "90 %"),
            Column("verdict"),
        ],
        rows=[
            (*verdicts.labels(one.cell), one.tests, one.driven, one.rate, one.interval, one.verdict)
            for one in verdicts.cells
            if one.tests
        ],
        notes=[
            f"A cell fails if more than {verdicts.tolerated:.0%} of tests like its own would fail, and is safe if "
            f"fewer would; either is meant to be wrong at most {ERROR_RATE:.0%} of the time. Otherwise it is disputed."
        ],
    )
