"""Predictors of the twin's failures, side by side: per test and per cell.

Every predictor sees the siblings' outcomes, features and conditions; none sees the twin's outcomes. The undriven
baseline, logistic models of road features and conditions, predicts each test from tests of other families: without
driving it, or a near copy of it, anywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ds_analysis.common.cross_validation import FOLDS, SEED, STRENGTHS, Columns, best_feature, bounded, standardised
from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError
from ds_analysis.common.statistics import Array, Bools, Indices, splits_of
from ds_analysis.prediction.twin_prediction import TwinPrediction, predict_twin
from ds_orchestrator.maps.algebra import OPERATORS


def undriven_probabilities(table: OutcomeTable, columns: Columns) -> Array:
    """Predict every test from the siblings' outcomes on tests of other families.

    Args:
        table: outcomes; the twin's are not looked at.
        columns: `all` features and conditions, or the `best` one.

    Returns:
        (tests,) probabilities of failure.

    Raises:
        OutcomeTableError: fewer than two families of tests have a verdict on a sibling.
    """
    from sklearn import config_context

    failures = sum(table.failed(name).astype(np.float64) for name in table.siblings)
    verdicts = sum(table.known(name).astype(np.float64) for name in table.siblings)
    counts = np.column_stack((failures, verdicts - failures))
    driven = np.flatnonzero(counts.sum(axis=1) > 0)
    if len(np.unique(table.families[driven])) < 2:
        raise OutcomeTableError("all tests descend from one road: expected two families of tests, or more")
    with config_context(assume_finite=True, skip_parameter_validation=True):
        found = np.empty(len(table))
        for others, test in splits_of(table.families, FOLDS, SEED):
            train = np.intersect1d(others, driven)
            model = _chosen(table.features[train], counts[train], table.families[train], columns)
            found[test] = _fitted(model, table.features[train], counts[train], table.features[test])
    return found


Model = tuple[list[int], float]
"""Columns of the features, and the inverse strength of the ridge penalty."""


def _chosen(features: Array, counts: Array, families: Indices, columns: Columns) -> Model:
    """Choose the strength of the penalty with the smallest loss on other families, the first of equal ones."""
    used = list(range(features.shape[1]))
    if columns == "best":
        rows = np.repeat(np.arange(len(counts)), counts.sum(axis=1).astype(int))
        failed = np.concatenate([np.repeat((True, False), pair) for pair in counts.astype(int)])
        used = [best_feature(features[rows], failed)]
    splits = list(splits_of(families, FOLDS, SEED + 1))
    if len(splits) < 2:
        return used, 1.0
    losses = []
    for strength in STRENGTHS:
        loss = 0.0
        for train, test in splits:
            probability = _fitted((used, strength), features[train], counts[train], features[test])
            loss -= float(counts[test, 0] @ np.log(probability) + counts[test, 1] @ np.log(1.0 - probability))
        losses.append(round(loss, 9))
    return used, STRENGTHS[int(np.argmin(losses))]


def _fitted(model: Model, features: Array, counts: Array, others: Array) -> Array:
    """Fit a model to failures and successes of training tests, and predict other tests."""
    from sklearn.linear_model import LogisticRegression

    used, strength = model
    total = counts.sum()
    if not counts.sum(axis=0).all():  # all failed, or none
        return bounded(np.full(len(others), counts[:, 0].sum() / total), int(total))
    train, test = standardised(features[:, used], others[:, used])
    fit = LogisticRegression(C=strength, solver="newton-cholesky").fit(
        np.vstack((train, train)),
        np.repeat((1, 0), len(train)),
        sample_weight=np.concatenate((counts[:, 0], counts[:, 1])),
    )
    return bounded(fit.predict_proba(test)[:, 1], int(total))


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


def comparable(table: OutcomeTable) -> Bools:
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
        probabilities={**driven, **merged(list(driven.values())), **models},
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
            **driven, **merged(list(driven.values())), **{name: rate(values) for name, values in models.items()}
        },
        weights=(tests > 0).astype(np.float64),
    )  # fmt: skip


def merged(driven: list[Array]) -> dict[str, Array]:
    """Every operator on the siblings' values; all siblings drove all tests, so weights are equal."""
    weights = np.ones(len(driven))
    return {name: operator.combine(np.array(driven), weights) for name, operator in OPERATORS.items()}
