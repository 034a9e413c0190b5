"""Selects the tests whose outcomes on a car would tell most about all other tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_analysis.prediction.outcome_table import OutcomeTable, State
from ds_analysis.prediction.twin_prediction import TwinPrediction

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

DRAWS = 500
"""Draws behind the covariances of tests; chosen: a choice among thousands of tests takes a second."""


class BudgetError(ValueError):
    """A number of drives that cannot be proposed."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A test to drive.

    Attributes:
        row: row of the test.
        gain: expected reduction of the mean squared error of all predicted probabilities, each cell counting the same,
            by this drive after those chosen before it.
    """

    row: int
    gain: float


def candidates_of(table: OutcomeTable, prediction: TwinPrediction) -> Indices:
    """Rows of the tests that a car can be asked to drive: judged by a sibling, excluded on none, not driven yet."""
    columns = [table.column(name) for name in table.siblings]
    states = table.states[:, columns]
    usable = np.isin(states, (State.COMPLETED, State.FAILED)).any(axis=1) & ~(states == State.EXCLUDED).any(axis=1)
    usable[[drive.row for drive in prediction.drives]] = False
    return np.flatnonzero(usable)


def choose(table: OutcomeTable, prediction: TwinPrediction, drives: int) -> list[Choice]:
    """Choose tests one after the other, each with the largest expected gain given those before.

    The gain of a verdict on test c about test j is cov(p_j, p_c)^2 / var(y_c) (the variance of p_j that a linear
    regression on the verdict y_c explains), over what is uncertain about the car. A chosen test takes its part out of
    all covariances, so that the next one tells something else; the sum over tests is submodular, and the greedy choice
    is near the best (Krause, Singh, Guestrin, JMLR 2008). Each family of mutants gives one test as long as others are
    left.

    Args:
        table: outcomes of the siblings.
        prediction: of the table's tests.
        drives: number of tests to choose.

    Raises:
        BudgetError: there are fewer candidates.
    """
    candidates = candidates_of(table, prediction)
    if drives > len(candidates):
        raise BudgetError(
            f"{drives} drives: {len(candidates)} tests can be proposed, expected a budget of at most {len(candidates)}"
        )
    draws = prediction.draws(DRAWS)
    mean = draws.mean(axis=0)
    noise = np.maximum(mean - (draws**2).mean(axis=0), 0.0)  # mean of p (1 - p): what a known car leaves to chance
    factor = (draws - mean) / np.sqrt(DRAWS)
    weights = _cell_weights(table)
    chosen: list[Choice] = []
    left = np.zeros(len(table), np.bool_)
    left[candidates] = True
    while len(chosen) < drives:
        fresh = left & ~np.isin(table.families, [table.families[one.row] for one in chosen])
        allowed = fresh if fresh.any() else left
        variance = (factor**2).sum(axis=0)
        total = variance + noise
        gram = (factor * weights) @ factor.T
        gain = np.where(total > _NOTHING, (factor * (gram @ factor)).sum(axis=0) / np.maximum(total, _NOTHING), 0.0)
        row = int(np.argmax(np.where(allowed, gain, -1.0)))
        chosen.append(Choice(row=row, gain=float(gain[row])))
        left[row] = False
        if variance[row] > _NOTHING:
            direction = factor[:, row] / np.sqrt(variance[row])
            kept = np.sqrt(noise[row] / total[row])
            factor = factor - (1.0 - kept) * np.outer(direction, direction @ factor)
    return chosen


def expected_error(table: OutcomeTable, prediction: TwinPrediction) -> float:
    """Expected mean squared error of all predicted probabilities, each cell counting the same, as in `choose`."""
    probabilities = prediction.probabilities()
    return float(_cell_weights(table) @ (probabilities * (1.0 - probabilities)))


_NOTHING = 1e-12
"""Variance below which a test tells nothing."""


def _cell_weights(table: OutcomeTable) -> Array:
    """Weights of tests, which sum to 1: every cell counts the same, and so does every test of a cell."""
    cells = {cell: k for k, cell in enumerate(dict.fromkeys(table.cells))}
    member = np.array([cells[cell] for cell in table.cells])
    weights = 1.0 / np.bincount(member)[member]
    return np.asarray(weights / weights.sum())
