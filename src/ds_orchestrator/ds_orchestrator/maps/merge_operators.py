"""How one cell of several siblings' maps becomes one value: the operators of the merge, and intervals of the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

LEVEL = 0.95
"""Probability that an interval holds the true value (chosen: the usual one, and the paper's alpha of 0.05)."""
DRAWS = 20_000
"""Draws from the posterior; chosen: ends of an interval are right to about 0.005, in a millisecond."""
_PRIOR = 0.5
"""Both parameters of the Beta distribution that is Jeffreys' prior of a probability."""

Values = NDArray[np.float64]
Operator = Callable[[Values, Values], Values]
"""From values (siblings, ...) and weights (siblings,), their numbers of tests, to values (...)."""


def product(values: Values, weights: Values) -> Values:
    """Paper 3.5, failure probability: only where all siblings fail often is the result high."""
    return np.asarray(np.prod(values, axis=0))


def minimum(values: Values, weights: Values) -> Values:
    """Paper 3.5, lack of driving quality: high where every sibling drives badly."""
    return np.asarray(np.min(values, axis=0))


def maximum(values: Values, weights: Values) -> Values:
    """Paper 3.5, for a measure that is high where driving is good; of failures it believes any sibling alone."""
    return np.asarray(np.max(values, axis=0))


def mean(values: Values, weights: Values) -> Values:
    """Not in the paper's 3.5: the default of the authors' package, beside which they print the product."""
    return np.asarray(np.mean(values, axis=0))


def weighted_mean(values: Values, weights: Values) -> Values:
    """Not in the paper's 3.5: the mean weighted by the siblings' numbers of tests, an option of the authors' package.

    Where all siblings ran all tests, as after the union of paper 3.4, it equals the mean.
    """
    return np.asarray(np.average(values, axis=0, weights=weights))


OPERATORS: Mapping[str, Operator] = {
    "product": product,
    "minimum": minimum,
    "maximum": maximum,
    "mean": mean,
    "weighted_mean": weighted_mean,
}
"""Every operator by its name in a configuration."""


def apply(operator: str, values: Sequence[float], tests: Sequence[int]) -> float:
    """One value of several siblings' values and numbers of tests; their order does not matter."""
    pairs = np.array(sorted(zip(values, tests, strict=True)), np.float64)
    return float(OPERATORS[operator](pairs[:, 0], pairs[:, 1]))


def jeffreys_interval(failures: int, tests: int) -> tuple[float, float]:
    """95 % interval of a failure probability: equal tails of its Beta posterior under Jeffreys' prior.

    Without failures the lower end is 0, without successes the upper one is 1, so that the interval holds the observed
    share (Brown, Cai, DasGupta, Statistical Science 2001, section 4.1.2).
    """
    tail = (1.0 - LEVEL) / 2.0
    posterior = failures + _PRIOR, tests - failures + _PRIOR
    return (
        0.0 if failures == 0 else float(betaincinv(*posterior, tail)),
        1.0 if failures == tests else float(betaincinv(*posterior, 1.0 - tail)),
    )


def merged_interval(operator: str, counts: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """95 % interval of a merged probability, from the posterior of every sibling's, not from their intervals' ends.

    Args:
        operator: of the merge.
        counts: failures and tests of every sibling; their order does not matter.

    Returns:
        Equal tails of what the operator makes of independent draws from the siblings' posteriors; an end on which all
        siblings agree without exception is 0 or 1, as in `jeffreys_interval`. The same counts give the same interval.
    """
    if len(counts) == 1:
        return jeffreys_interval(*counts[0])
    return _merged_interval(operator, tuple(sorted(counts)))


@lru_cache(maxsize=4096)
def _merged_interval(operator: str, counts: tuple[tuple[int, int], ...]) -> tuple[float, float]:
    failures, tests = np.array(counts, np.float64).T
    rng = np.random.default_rng([list(OPERATORS).index(operator), *(n for pair in counts for n in pair)])
    draws = rng.beta((failures + _PRIOR)[:, None], (tests - failures + _PRIOR)[:, None], (len(counts), DRAWS))
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(OPERATORS[operator](draws, tests), [tail, 1.0 - tail])
    merged = float(OPERATORS[operator](failures / tests, tests))
    return (0.0 if merged == 0.0 else float(low), 1.0 if merged == 1.0 else float(high))
