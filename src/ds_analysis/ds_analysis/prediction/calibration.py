"""Forecasts of cells' failure rates, and how often their intervals hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.prediction.twin_prediction import TwinPrediction

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


def forecast_cells(table: OutcomeTable, prediction: TwinPrediction, *, fewest: int = 1) -> list[CellForecast]:
    """Forecast the failure rate of the tests of every cell.

    Args:
        table: outcomes.
        prediction: of the table's tests.
        fewest: tests that a cell must have.
    """
    known = None if table.twin is None else table.known(table.twin)
    members: dict[tuple[int, ...], list[int]] = {}
    for k, cell in enumerate(table.cells):
        if cell is not None and table.on_siblings[k] and (known is None or known[k]):
            members.setdefault(cell, []).append(k)
    rng = np.random.default_rng(SEED)
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
