"""Scores of predicted probabilities, for many weightings of the same rows at once.

A bootstrap over families is a weighting: every row counts as often as its family was drawn. All scores below take
predictions and truth (rows,), or (resamples, rows) where they depend on the resample, and weights (resamples, rows),
so that a thousand resamples cost a few array operations. They are NaN where a score is not defined; `interval_of`
leaves such resamples out.
"""

from __future__ import annotations

import numpy as np

from ds_analysis.common.statistics import Array, Indices, ranks
from ds_orchestrator.maps.algebra import LEVEL

_NO_WIDTH = 1e-9
"""Width below which an interval is a single point."""
_BLOCK = 500_000
"""Weights whose precision is computed at once; chosen: 4 MB for each array."""
_CONSTANT = 1e-18
"""Product of two variances below which a correlation is rounding."""


def family_weights(families: Indices, resamples: int, seed: int) -> Array:
    """Draw whole families with replacement, as often as there are families.

    A cluster bootstrap (Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).

    Args:
        families: (rows,) family of each row.
        resamples: number of resamples.
        seed: seed of the draws.

    Returns:
        (resamples + 1, rows) how often each row counts; the first resample is the sample itself.
    """
    known, member = np.unique(families, return_inverse=True)
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(len(known), np.full(len(known), 1.0 / len(known)), size=resamples)
    return np.asarray(np.vstack((np.ones(len(known)), drawn))[:, member])


def interval_of(scores: Array) -> tuple[float, float] | None:
    """95 % percentile interval of a score's resamples.

    None where the score is defined in no resample, or the same in all: such an interval has no width because the sample
    is degenerate, not because the score is known so well.
    """
    defined = scores[1:][~np.isnan(scores[1:])]
    if not len(defined):
        return None
    low, high = np.quantile(defined, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return None if high - low < _NO_WIDTH else (float(low), float(high))


def mean_of(values: Array, weights: Array) -> Array:
    """(resamples,) weighted means; NaN where all weights are 0."""
    total = weights @ values if values.ndim == 1 else (weights * values).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / weights.sum(axis=1))


def brier(predicted: Array, truth: Array, weights: Array) -> Array:
    """(resamples,) mean squared error of probabilities (Brier 1950); truth may be a rate."""
    return mean_of((predicted - truth) ** 2, weights)


def log_loss(predicted: Array, truth: Array, weights: Array) -> Array:
    """(resamples,) mean logarithmic loss, bits; truth may be a rate, whose own entropy is then part of the loss."""
    return mean_of(-truth * np.log2(predicted) - (1.0 - truth) * np.log2(1.0 - predicted), weights)


def recall(predicted: Array, failing: Array, weights: Array, threshold: float) -> Array:
    """(resamples,) share of failing rows that are predicted with at least a threshold; NaN without failing rows."""
    return mean_of((predicted >= threshold).astype(np.float64), weights * failing)


def false_alarms(predicted: Array, failing: Array, weights: Array, threshold: float) -> Array:
    """(resamples,) share of rows that do not fail but are predicted with at least a threshold; NaN without any."""
    return mean_of((predicted >= threshold).astype(np.float64), weights * (1.0 - failing))


def pearson(predicted: Array, truth: Array, weights: Array) -> Array:
    """(resamples,) Pearson's r; NaN where one of them is constant."""
    x, y = mean_of(predicted, weights), mean_of(truth, weights)
    xx, yy, xy = (mean_of(v, weights) for v in (predicted**2, truth**2, predicted * truth))
    spread = (xx - x * x) * (yy - y * y)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(spread > _CONSTANT, (xy - x * y) / np.sqrt(spread), np.nan))


def average_precision(predicted: Array, failing: Array, weights: Array) -> Array:
    """(resamples,) area under the precision-recall curve: mean precision over the failing rows.

    Equal predictions share one point of the curve, as in scikit-learn's `average_precision_score`. NaN without failing
    rows.
    """
    if predicted.ndim == 1:
        parts = np.array_split(weights, weights.size // _BLOCK + 1)
        return np.concatenate([_average_precision(predicted, failing * part, part) for part in parts])
    hits = failing * weights
    return np.concatenate(
        [_average_precision(p, h[None], w[None]) for p, h, w in zip(predicted, hits, weights, strict=True)]
    )


def _average_precision(predicted: Array, hits: Array, weights: Array) -> Array:
    order, ends = ranks(predicted)
    found = np.cumsum(hits[:, order], axis=1)[:, ends]
    seen = np.cumsum(weights[:, order], axis=1)[:, ends]
    with np.errstate(invalid="ignore", divide="ignore"):
        precision = np.where(seen > 0.0, found / seen, 0.0)
        return np.asarray((precision * np.diff(found, axis=1, prepend=0.0)).sum(axis=1) / found[:, -1])
