"""Operators that merge a cell of several siblings' maps into one value, and intervals of the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from ds_sim.extension import ExtensionError, is_extension, load_extension

LEVEL = 0.95
"""Coverage of intervals; chosen: the usual one, matching the paper's alpha of 0.05."""
DRAWS = 20_000
"""Draws from the posterior; chosen: ends of an interval are accurate to about 0.005, in 1 ms."""
_PRIOR = 0.5
"""Both parameters of Jeffreys' prior of a probability, a Beta distribution."""

Values = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MergeOperator:
    """Rule that merges several siblings' values of a cell into one.

    Attributes:
        combine: computes values (...) from values (siblings, ...) and weights (siblings,), the numbers of tests.
        seed: seed of the draws of `merged_interval`; a constant of the operator, so that adding or reordering
            operators changes no interval.
    """

    combine: Callable[[Values, Values], Values]
    seed: int


def product(values: Values, weights: Values) -> Values:
    """Multiply failure probabilities (paper 3.5): high only where all siblings fail often."""
    return np.asarray(np.prod(values, axis=0))


def minimum(values: Values, weights: Values) -> Values:
    """Take the smallest quality loss (paper 3.5): high where every sibling drives badly."""
    return np.asarray(np.min(values, axis=0))


def maximum(values: Values, weights: Values) -> Values:
    """Take the largest value (paper 3.5, for measures that are high where driving is good): one sibling suffices."""
    return np.asarray(np.max(values, axis=0))


def mean(values: Values, weights: Values) -> Values:
    """Average with equal weights: not in paper 3.5, but the default of the authors' package."""
    return np.asarray(np.mean(values, axis=0))


def weighted_mean(values: Values, weights: Values) -> Values:
    """Average weighted by the siblings' numbers of tests: not in paper 3.5, an option of the authors' package.

    Equals the mean if all siblings ran all tests, as after the union of paper 3.4.
    """
    return np.asarray(np.average(values, axis=0, weights=weights))


OPERATORS: Mapping[str, MergeOperator] = {
    "product": MergeOperator(combine=product, seed=0),
    "minimum": MergeOperator(combine=minimum, seed=1),
    "maximum": MergeOperator(combine=maximum, seed=2),
    "mean": MergeOperator(combine=mean, seed=3),
    "weighted_mean": MergeOperator(combine=weighted_mean, seed=4),
}
"""Operators by their name in a configuration. A new operator needs a seed that no other has."""


def operator_of(name: str) -> MergeOperator:
    """Look up an operator: a key of `OPERATORS`, or `module:NAME`, a `MergeOperator`.

    Raises:
        ds_sim.extension.ExtensionError: the name is unknown, or leads to no operator.
    """
    if name in OPERATORS:
        return OPERATORS[name]
    if not is_extension(name):
        raise ExtensionError(f"unknown operator {name!r}: expected one of {', '.join(OPERATORS)}, or module:NAME")
    return load_extension(name, MergeOperator, "operator")


def apply(operator: str, values: Sequence[float], tests: Sequence[int]) -> float:
    """Merge several siblings' values, given their numbers of tests; the order of the siblings does not matter.

    Examples:
        >>> from ds_orchestrator.maps.merge_operators import apply
        >>> apply("product", values=[0.5, 0.2], tests=[4, 10]), apply("maximum", [0.5, 0.2], [4, 10])
        (0.1, 0.5)
    """
    pairs = np.array(sorted(zip(values, tests, strict=True)), np.float64)
    return float(operator_of(operator).combine(pairs[:, 0], pairs[:, 1]))


def jeffreys_interval(failures: int, tests: int) -> tuple[float, float]:
    """Estimate a 95 % interval of a failure probability: equal tails of its Beta posterior under Jeffreys' prior.

    Without failures the lower end is 0, without successes the upper end is 1, so that the interval contains the
    observed share (Brown, Cai, DasGupta, Statistical Science 2001, section 4.1.2).

    Examples:
        >>> from ds_orchestrator import jeffreys_interval
        >>> [round(end, 3) for end in jeffreys_interval(failures=0, tests=10)]
        [0.0, 0.217]
    """
    tail = (1.0 - LEVEL) / 2.0
    posterior = failures + _PRIOR, tests - failures + _PRIOR
    return (
        0.0 if failures == 0 else float(betaincinv(*posterior, tail)),
        1.0 if failures == tests else float(betaincinv(*posterior, 1.0 - tail)),
    )


def merged_interval(operator: str, counts: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Estimate a 95 % interval of a merged probability from the siblings' posteriors, not from their intervals' ends.

    Args:
        operator: name of the merge operator.
        counts: failures and tests of every sibling; their order does not matter.

    Returns:
        Equal tails of the operator's values over independent draws from the siblings' posteriors; if the merged share
        is exactly 0 or 1, so is that end, as in `jeffreys_interval`. Equal counts give equal intervals.

    Examples:
        >>> from ds_orchestrator.maps.merge_operators import merged_interval
        >>> [round(end, 1) for end in merged_interval("product", [(5, 10), (2, 10)])]
        [0.0, 0.3]
    """
    if len(counts) == 1:
        return jeffreys_interval(*counts[0])
    return _merged_interval(operator, tuple(sorted(counts)))


@lru_cache(maxsize=4096)
def _merged_interval(operator: str, counts: tuple[tuple[int, int], ...]) -> tuple[float, float]:
    merge = operator_of(operator)
    failures, tests = np.array(counts, np.float64).T
    rng = np.random.default_rng([merge.seed, *(n for pair in counts for n in pair)])
    draws = rng.beta((failures + _PRIOR)[:, None], (tests - failures + _PRIOR)[:, None], (len(counts), DRAWS))
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(merge.combine(draws, tests), [tail, 1.0 - tail])
    merged = float(merge.combine(failures / tests, tests))
    return (0.0 if merged == 0.0 else float(low), 1.0 if merged == 1.0 else float(high))
