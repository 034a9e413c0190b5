"""The undriven baseline of a simulator that was never driven: logistic models of road features and conditions.

They are fitted to the siblings' outcomes alone, and predict each test from tests of other families, so that a test is
predicted without driving it, or a near copy of it, anywhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.cross_validation import FOLDS, SEED, STRENGTHS, Array, Columns, auc_roc, bounded
from ds_analysis.common.families import parts_of
from ds_analysis.prediction.outcome_table import OutcomeTable, OutcomeTableError

Indices = NDArray[np.intp]


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
        parts = parts_of(table.families, FOLDS, SEED)
        for part in np.unique(parts):
            train, test = driven[parts[driven] != part], np.flatnonzero(parts == part)
            model = _chosen(table.features[train], counts[train], table.families[train], columns)
            found[test] = _fitted(model, table.features[train], counts[train], table.features[test])
    return found


Model = tuple[list[int], float]
"""Columns of the features, and the inverse strength of the ridge penalty."""


def _chosen(features: Array, counts: Array, families: Indices, columns: Columns) -> Model:
    """Choose the strength of the penalty with the smallest loss on other families, the first of equal ones."""
    used = [_best(features, counts)] if columns == "best" else list(range(features.shape[1]))
    parts = parts_of(families, FOLDS, SEED + 1)
    if len(np.unique(parts)) < 2:
        return used, 1.0
    losses = []
    for strength in STRENGTHS:
        loss = 0.0
        for part in np.unique(parts):
            train, test = parts != part, parts == part
            probability = _fitted((used, strength), features[train], counts[train], features[test])
            loss -= float(counts[test, 0] @ np.log(probability) + counts[test, 1] @ np.log(1.0 - probability))
        losses.append(round(loss, 9))
    return used, STRENGTHS[int(np.argmin(losses))]


def _best(features: Array, counts: Array) -> int:
    """Feature that ranks failures best, in whichever direction; the first of equal ones."""
    rows = np.repeat(np.arange(len(counts)), counts.sum(axis=1).astype(int))
    failed = np.concatenate([np.repeat((True, False), pair) for pair in counts.astype(int)])
    if failed.all() or not failed.any():
        return 0
    area = auc_roc(features[rows], failed)
    return int(np.argmax(np.round(np.maximum(area, 1.0 - area), 12)))


def _fitted(model: Model, features: Array, counts: Array, others: Array) -> Array:
    """Fit a model to failures and successes of training tests, and predict other tests."""
    from sklearn.linear_model import LogisticRegression

    used, strength = model
    total = counts.sum()
    if not counts.sum(axis=0).all():  # all failed, or none
        return bounded(np.full(len(others), counts[:, 0].sum() / total), int(total))
    centre, scale = features[:, used].mean(axis=0), features[:, used].std(axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    train, test = ((values[:, used] - centre) / scale for values in (features, others))
    fit = LogisticRegression(C=strength, solver="newton-cholesky").fit(
        np.vstack((train, train)),
        np.repeat((1, 0), len(train)),
        sample_weight=np.concatenate((counts[:, 0], counts[:, 1])),
    )
    return bounded(fit.predict_proba(test)[:, 1], int(total))
