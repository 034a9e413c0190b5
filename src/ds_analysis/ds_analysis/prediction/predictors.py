"""Predictors of the twin's failures, side by side: per test and per cell.

Every predictor sees the siblings' outcomes, features and conditions; none sees the twin's outcomes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_analysis.prediction.outcome_table import OutcomeTable, OutcomeTableError
from ds_analysis.prediction.twin_prediction import TwinPrediction, predict_twin
from ds_analysis.prediction.undriven import undriven_probabilities
from ds_orchestrator.maps.algebra import OPERATORS

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

UNDRIVEN = "undriven features"
"""Predictor that every other one has to beat."""
SINGLE = "best single feature"
HIERARCHICAL = "hierarchical model"


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictions:
    """Predictions of the same rows by every predictor.

    Attributes:
        level: rows are tests, or cells.
        rows: test ids, or cells.
        truth: (rows,) whether the twin failed the test, or (resamples, rows) its failure rate in the cell.
        probabilities: predictor -> (rows,), or (resamples, rows), probabilities.
        weights: (resamples, rows) how often each row counts; the first resample is the sample itself.
    """

    level: str
    rows: tuple[object, ...]
    truth: Array
    probabilities: Mapping[str, Array]
    weights: Array


def comparable(table: OutcomeTable) -> NDArray[np.bool_]:
    """(tests,) tests with a verdict on every sibling and on the twin.

    Raises:
        OutcomeTableError: there is no twin, or no such test.
    """
    if table.twin is None:
        raise OutcomeTableError(
            "there is no twin to compare predictions with: name a simulator that plays it, as in --twin "
            f"{table.siblings[-1]}"
        )
    rows = table.on_siblings & table.known(table.twin)
    if not rows.any():
        raise OutcomeTableError(
            f"no test has a verdict on every sibling and on {table.twin}: let the campaign drive the twin first"
        )
    return np.asarray(rows)


def modelled(table: OutcomeTable, prediction: TwinPrediction | None = None) -> Mapping[str, Array]:
    """Fit the models to the siblings' outcomes.

    Args:
        table: outcomes; those of the twin are not looked at.
        prediction: of the hierarchical model, if it is known already.

    Returns:
        Predictor -> (tests,) probabilities of failure on the twin.
    """
    known = predict_twin(table) if prediction is None else prediction
    return {
        UNDRIVEN: undriven_probabilities(table, "all"),
        SINGLE: undriven_probabilities(table, "best"),
        HIERARCHICAL: known.probabilities(),
    }


def predict_tests(table: OutcomeTable, models: Mapping[str, Array], weights: Array) -> Predictions:
    """Predict tests: a sibling by its own outcome there, an operator by merging the siblings' outcomes.

    Args:
        table: outcomes, all comparable.
        models: predictor -> (tests,) probabilities.
        weights: (resamples, tests) how often each test counts.
    """
    driven = {name: table.failed(name).astype(np.float64) for name in table.siblings}
    return Predictions(
        level="test",
        rows=table.test_ids,
        truth=table.failed(str(table.twin)).astype(np.float64),
        probabilities={**driven, **_merged(list(driven.values())), **models},
        weights=weights,
    )


def predict_cells(table: OutcomeTable, models: Mapping[str, Array], weights: Array) -> Predictions:
    """Predict failure rates of cells: the paper's maps, and the mean of each model over the tests of a cell.

    Rates are those of the resampled tests, so that intervals know how few tests a cell has.
    """
    filled = [k for k, cell in enumerate(table.cells) if cell is not None]
    cells = sorted({cell for cell in table.cells if cell is not None})
    index = {cell: k for k, cell in enumerate(cells)}
    member = np.zeros((len(table), len(cells)))
    for k in filled:
        member[k, index[table.cells[k]]] = 1.0  # type: ignore[index]
    tests = weights @ member

    def rate(values: Array) -> Array:
        return np.asarray(((weights * values) @ member) / np.maximum(tests, 1.0))

    driven = {name: rate(table.failed(name).astype(np.float64)) for name in table.siblings}
    return Predictions(
        level="cell",
        rows=tuple(cells),
        truth=rate(table.failed(str(table.twin)).astype(np.float64)),
        probabilities={
            **driven, **_merged(list(driven.values())), **{name: rate(values) for name, values in models.items()}
        },
        weights=(tests > 0).astype(np.float64),
    )  # fmt: skip


def _merged(driven: list[Array]) -> dict[str, Array]:
    """Every operator on the siblings' values; all siblings drove all tests, so weights are equal."""
    weights = np.ones(len(driven))
    return {name: operator.combine(np.array(driven), weights) for name, operator in OPERATORS.items()}
