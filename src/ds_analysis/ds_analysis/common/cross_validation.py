# SPDX-License-Identifier: Apache-2.0
"""Predicts failures on roads by logistic models that are chosen, as they are fitted, on the training roads alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from scipy.special import expit, logit
from scipy.stats import rankdata

from ds_analysis.common.statistics import Array, Bools, Indices, are_alone, splits_of

Columns = Literal["best", "all"]
"""Predictors of a model: the single feature that separates the training roads best, or all features."""

FOLDS = 5
"""Parts of the roads, each predicted from the others; usual (Hastie, Tibshirani, Friedman, section 7.10)."""
REPEATS = 3
"""Divisions over which losses are averaged; chosen: one alone moves a loss by a few hundredths of a bit."""
STRENGTHS = (0.1, 1.0, 10.0, 100.0)
"""Inverse strengths of the ridge penalty on standardised features; chosen: from hardly a slope to nearly a step."""
ADDED_STRENGTH = 1.0
"""The same for predictors that are added to a prediction: a normal prior with a standard deviation of 1. Chosen: by two
of these a predictor multiplies the odds by 7, so that predictors without information cost little."""
_NOTHING_NEW = 1e-9
"""Share of a predictor's spread below which the rest is rounding."""
SEED = 14
"""Seed of the divisions; any number does."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fold:
    """Indices of (m,) training roads and of a (k,) part of the roads, and logits of failure on both."""

    repeat: int
    train: Indices
    test: Indices
    known: Array  # (m,) each from a model of training roads in other inner parts
    predicted: Array  # (k,) from a model of all training roads


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictions:
    """Predictions from road features."""

    probability: Array  # (repeats, roads) of failure, each from a model that did not see the road; see `bounded`
    folds: Sequence[Fold]
    # Index of the feature that separated the training roads best -> number of folds in which it did.
    chosen: Counter[int]


def predict_failures(
    features: Array,
    failed: Bools,
    *,
    families: Indices | None = None,
    columns: Sequence[Columns] = ("best", "all"),
    repeats: int = REPEATS,
) -> Predictions:
    """Predict (roads,) outcomes, ten of each kind or more, by a logistic model on (roads, features) of the other roads.

    The other roads are those of other families, if roads have any. In each training part, a second cross-validation
    chooses the model (set of columns and strength of the penalty) with the smallest loss.
    """
    from sklearn import config_context

    models = list(product(columns, STRENGTHS))
    families = np.arange(len(failed)) if families is None else families
    probability, folds, chosen = np.empty((repeats, len(failed))), [], Counter[int]()
    # The values are checked already; checking them in each of thousands of fits would take most of the time.
    with config_context(assume_finite=True, skip_parameter_validation=True):
        for repeat in range(repeats):
            for train, test in folds_of(failed, families, SEED + repeat):
                training, outcome = features[train], failed[train]
                model, held_out = _chosen(models, training, outcome, families[train], SEED + repeat)
                best = best_feature(training, outcome)
                probability[repeat, test] = _fitted(model, best, training, outcome, features[test])
                chosen[best] += 1
                predicted = logit(probability[repeat, test])
                folds.append(Fold(repeat=repeat, train=train, test=test, known=logit(held_out), predicted=predicted))
    return Predictions(probability=probability, folds=folds, chosen=chosen)


def predict_with(predictions: Predictions, failed: Bools, added: Array) -> Array:
    """Add (roads, k) predictors to predictions, by a logistic model with the logits as offset: (repeats, roads).

    Of each added predictor only its residual counts after a linear regression on the logits and on the predictors
    before it. So it can neither recalibrate the prediction, nor undo the penalty on one that it repeats.
    """
    from statsmodels.genmod.families import Binomial
    from statsmodels.genmod.generalized_linear_model import GLM

    probability = np.empty_like(predictions.probability)
    for fold in predictions.folds:
        train, test = _new_parts(fold, added)
        model = GLM(failed[fold.train].astype(np.float64), _with_ones(train), Binomial(), offset=fold.known)
        alpha = 1.0 / (ADDED_STRENGTH * len(train))  # statsmodels divides the likelihood by the number of roads
        fit = model.fit_regularized(alpha=alpha, L1_wt=0.0)
        probabilities = expit(fold.predicted + _with_ones(test) @ fit.params)
        probability[fold.repeat, fold.test] = bounded(probabilities, len(train))
    return probability


def bits(probability: Array, failed: Bools) -> Array:
    """Mean logarithmic loss over the repeats: bits by which each outcome still surprises, (roads,)."""
    return np.asarray(-np.log2(np.where(failed, probability, 1.0 - probability)).mean(axis=0))


def bounded(probability: Array, roads: int) -> Array:
    """Keep probabilities of a model of n roads 1 / (n + 2) away from 0 and 1 (Laplace's rule of succession)."""
    least = 1.0 / (roads + 2)
    return np.asarray(np.clip(probability, least, 1.0 - least))


def folds_of(failed: Bools, families: Indices, seed: int) -> Iterator[tuple[Indices, Indices]]:
    """Yield training and test indices of `FOLDS` parts: of whole families, or with about equal shares of failures."""
    from sklearn.model_selection import StratifiedKFold

    if not are_alone(families):
        yield from splits_of(families, FOLDS, seed)
    else:
        yield from StratifiedKFold(FOLDS, shuffle=True, random_state=seed).split(failed, failed)


def best_feature(features: Array, failed: Bools) -> int:
    """Index of the feature with the largest AUC-ROC for failures, in whichever direction; the first of equal ones."""
    if failed.all() or not failed.any():
        return 0
    auc = auc_roc_by_ranks(features, failed)
    return int(np.argmax(np.round(np.maximum(auc, 1.0 - auc), 12)))


def auc_roc_by_ranks(values: Array, failed: Bools) -> Array:
    """Area under the ROC curve of each column of values, from ranks (Mann and Whitney); equal values count half."""
    failures = int(failed.sum())
    ranks = rankdata(values, axis=0)[failed].sum(axis=0) - failures * (failures + 1) / 2
    return np.asarray(ranks / (failures * (len(failed) - failures)), np.float64)


def _chosen(
    models: Sequence[tuple[Columns, float]], features: Array, failed: Bools, families: Indices, seed: int
) -> tuple[tuple[Columns, float], Array]:
    """Choose the model with the smallest cross-validated loss; return it, and each road's probability by the others."""
    predictions = np.empty((len(models), len(failed)))
    for train, test in folds_of(failed, families, seed):
        best = best_feature(features[train], failed[train])
        for k, model in enumerate(models):
            predictions[k, test] = _fitted(model, best, features[train], failed[train], features[test])
    losses = [round(float(bits(one[None], failed).sum()), 9) for one in predictions]
    least = int(np.argmin(losses))
    return models[least], predictions[least]


def _fitted(model: tuple[Columns, float], best: int, features: Array, failed: Bools, others: Array) -> Array:
    """Fit a model of all features, or of the best one, to training roads, and predict failures on other roads."""
    from sklearn.linear_model import LogisticRegression

    if failed.all() or not failed.any():
        return bounded(np.full(len(others), float(failed[0])), len(failed))
    columns, strength = model
    used = [best] if columns == "best" else slice(None)
    train, test = standardised(features[:, used], others[:, used])
    fit = LogisticRegression(C=strength, solver="newton-cholesky").fit(train, failed)
    return bounded(fit.predict_proba(test)[:, 1], len(train))


def standardised(train: Array, test: Array) -> tuple[Array, Array]:
    """Subtract the mean of the training roads and divide by their standard deviation, unless it is 0."""
    centre, scale = train.mean(axis=0), train.std(axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    return (train - centre) / scale, (test - centre) / scale


def _new_parts(fold: Fold, added: Array) -> tuple[Array, Array]:
    """What each predictor adds to the logits and those before it, over its spread; none of those that add nothing."""
    train, test = (
        np.column_stack((logits, added[roads]))
        for logits, roads in ((fold.known, fold.train), (fold.predicted, fold.test))
    )
    train, test = standardised(train, test)
    new, new_test = [], []
    for k in range(added.shape[1]):
        before, at = _with_ones(train[:, : k + 1]), _with_ones(test[:, : k + 1])
        weights = np.linalg.lstsq(before, train[:, k + 1], rcond=None)[0]
        residual = train[:, k + 1] - before @ weights
        spread = float(residual.std())
        if spread > _NOTHING_NEW:
            new.append(residual / spread)
            new_test.append((test[:, k + 1] - at @ weights) / spread)
    return np.array(new).reshape(-1, len(train)).T, np.array(new_test).reshape(-1, len(test)).T


def _with_ones(predictors: Array) -> Array:
    return np.column_stack((np.ones(len(predictors)), predictors))
