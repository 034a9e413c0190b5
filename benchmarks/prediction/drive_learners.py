"""Baselines that learn from the same drives on a car as the hierarchical model does, in simpler ways.

A few drives tell how bad a car is, whatever else they tell; the model has to be better than what follows from that.
Added after the first results of `benchmarks.prediction.real_budget`, before any of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import expit, log_expit, logit

Array = NDArray[np.float64]

RATE = "rate of the drives"
SHIFTED = "undriven features, shifted"
LEARNERS = (RATE, SHIFTED)
SHIFT_SCALE = 2.5
"""Standard deviation of the shift's prior in logits; the weakly informative scale of Gelman et al., Ann. Appl. Stat.
2(4), 2008."""
LARGEST_SHIFT = 6 * SHIFT_SCALE


def learned(undriven: Array, truth: Array, rows: Sequence[int]) -> Mapping[str, Array]:
    """Predict all tests from the outcomes of driven ones.

    Args:
        undriven: (tests,) probabilities of failure by road features and conditions.
        truth: (tests,) 1.0 where the car fails; only driven tests are looked at.
        rows: driven tests.

    Returns:
        Predictor -> (tests,) probabilities; driven tests have their outcomes. `RATE` is the mean of Jeffreys'
        posterior, the same for all other tests; `SHIFTED` adds one number to the features' logits, the mode of its
        posterior.
    """
    known = truth[list(rows)]
    logits = logit(undriven)

    def loss(shift: float) -> float:
        moved = logits[list(rows)] + shift
        likelihood = known @ log_expit(moved) + (1.0 - known) @ log_expit(-moved)
        return 0.5 * (shift / SHIFT_SCALE) ** 2 - float(likelihood)

    shift = float(minimize_scalar(loss, bounds=(-LARGEST_SHIFT, LARGEST_SHIFT), method="bounded").x)
    rate = (float(known.sum()) + 0.5) / (len(known) + 1.0)
    found = {RATE: np.full(len(truth), rate), SHIFTED: expit(logits + shift)}
    for probabilities in found.values():
        probabilities[list(rows)] = known
    return found
