"""Kernel inception distance between two sets of images (Binkowski et al. 2018), with bootstrap intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 200
"""Bootstrap resamples; chosen: the ends of a 95 % interval are then known to a tenth of its width."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Distance:
    """Squared maximum mean discrepancy, and its 95 % interval.

    Attributes:
        value: unbiased estimate; it may be negative near 0.
        low: lower end.
        high: upper end.
    """

    value: float
    low: float
    high: float


def kernel_distance(features: NDArray[np.float32], others: NDArray[np.float32], *, seed: int = 1) -> Distance:
    """Estimate the distance of two samples with the kernel (x y / d + 1)^3.

    Args:
        features: (n, d), n > 1.
        others: (m, d), m > 1.
        seed: seed of the bootstrap, which draws images of both sets with replacement.
    """
    x, y = features.astype(np.float64), others.astype(np.float64)
    # Rescaling both alike changes the unit of the distance only, and keeps cubes in range.
    scale = float(np.sqrt(np.mean(np.concatenate((x, y)) ** 2))) or 1.0
    x, y = x / scale, y / scale
    within_x, within_y, between = (((a @ b.T) / x.shape[1] + 1.0) ** 3 for a, b in ((x, x), (y, y), (x, y)))
    rng = np.random.default_rng(seed)
    values = []
    for _ in range(RESAMPLES):
        w = np.bincount(rng.integers(len(x), size=len(x)), minlength=len(x)).astype(np.float64)
        v = np.bincount(rng.integers(len(y), size=len(y)), minlength=len(y)).astype(np.float64)
        values.append(_estimate(within_x, within_y, between, w, v))
    low, high = np.quantile(values, (0.025, 0.975))
    value = _estimate(within_x, within_y, between, np.ones(len(x)), np.ones(len(y)))
    return Distance(value=value, low=float(low), high=float(high))


def _estimate(
    within_x: NDArray[np.float64],
    within_y: NDArray[np.float64],
    between: NDArray[np.float64],
    w: NDArray[np.float64],
    v: NDArray[np.float64],
) -> float:
    """Weighted unbiased estimate; pairs of an image with itself do not count, however often it was drawn."""

    def mean(kernel: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
        same = weights**2
        pairs = weights.sum() ** 2 - same.sum()
        return float((weights @ kernel @ weights - same @ np.diag(kernel)) / pairs)

    return mean(within_x, w) + mean(within_y, v) - 2.0 * float(w @ between @ v / (w.sum() * v.sum()))
