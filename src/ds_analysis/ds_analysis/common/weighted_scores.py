# SPDX-License-Identifier: Apache-2.0
"""Scores of predicted probabilities, for many weightings of the same rows at once.

A bootstrap over families is a weighting: every row counts as often as its family was drawn. All scores below take
predictions and truth (rows,), or (resamples, rows) where they depend on the resample, and weights (resamples, rows),
so that a thousand resamples cost a few array operations. They are NaN where a score is not defined; `interval_of`
leaves such resamples out.
"""

from __future__ import annotations

import numpy as np

from ds_analysis.common.statistics import Array, Indices
from ds_base.intervals import LEVEL

_NO_WIDTH = 1e-9
"""Width below which an interval is a single point."""


def family_weights(families: Indices, resamples: int, seed: int) -> Array:
    """(resamples + 1, rows) how often each row counts where whole families are drawn; the first resample is the sample.

    Families are drawn with replacement, as often as there are families: a cluster bootstrap (Davison and Hinkley,
    Bootstrap Methods and their Application, 1997, section 3.8).
    """
    distinct, member = np.unique(families, return_inverse=True)
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(len(distinct), np.full(len(distinct), 1.0 / len(distinct)), size=resamples)
    return np.asarray(np.vstack((np.ones(len(distinct)), drawn))[:, member])


def interval_of(scores: Array) -> tuple[float, float] | None:
    """95% percentile interval of a score's resamples.

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
