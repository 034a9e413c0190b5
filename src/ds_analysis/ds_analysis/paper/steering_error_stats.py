# SPDX-License-Identifier: Apache-2.0
"""Statistics of steering errors in open loop: sizes, densities, and similarity of two groups (paper 4.3.1, RQ1)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import ks_2samp, wasserstein_distance, wilcoxon

from ds_analysis.common.statistics import Array
from ds_analysis.paper.open_loop import OpenLoopAnswers, OpenLoopError

MERGED = "merged"
"""Name of all siblings' errors concatenated (paper 4.3.1: their combination)."""
RANGE, BINS = 0.6, 15
"""Errors up to 0.6 in bins of 0.04 (maxitwo)."""
ALPHA, POWER = 0.05, 0.8
"""Significance level and sufficient power (paper 4.3.1)."""
EDGES = np.linspace(-2.0, 2.0, 201)
"""Bin edges of `density`: every possible error in steps of 0.02; chosen: a hundredth of the steering range."""


@dataclass(frozen=True)
class ErrorSummary:
    """Summary of the steering errors of a group of recordings."""

    group: str
    images: int
    answered: int
    compared: int  # number of answered images with recorded steering
    mean: float | None  # mean error, positive to the right; None without errors, as are the following
    mean_absolute: float | None
    root_mean_square: float | None
    median_absolute: float | None
    largest: float | None
    outputs_apart: float | None  # Wasserstein distance between answered and recorded steering as distributions


def pooled_errors(answers: Sequence[OpenLoopAnswers]) -> dict[str, Array]:
    """Concatenate the errors of each group's recordings; groups without errors are left out."""
    groups: dict[str, list[Array]] = {}
    for one in answers:
        groups.setdefault(one.group, []).append(one.errors)
    pooled = {group: np.concatenate(parts) for group, parts in groups.items()}
    return {group: errors for group, errors in pooled.items() if errors.size}


def summarise(answers: Sequence[OpenLoopAnswers]) -> list[ErrorSummary]:
    """Summarise each group, in the order of its first recording."""
    return [
        _summary(group, [a for a in answers if a.group == group]) for group in dict.fromkeys(a.group for a in answers)
    ]


def _summary(group: str, answers: Sequence[OpenLoopAnswers]) -> ErrorSummary:
    errors = np.concatenate([one.errors for one in answers])
    recorded = np.concatenate([one.recorded for one in answers])
    answered = np.concatenate([one.answered for one in answers])
    both, size = np.isfinite(recorded) & np.isfinite(answered), np.abs(errors)
    counts = sum(one.images for one in answers), int(np.isfinite(answered).sum()), int(errors.size)
    if not errors.size:
        return ErrorSummary(group, *counts, *[None] * 6)
    sizes = errors.mean(), size.mean(), np.sqrt(np.mean(errors**2)), np.median(size), size.max()
    return ErrorSummary(group, *counts, *map(float, (*sizes, wasserstein_distance(answered[both], recorded[both]))))


def density(errors: Array) -> Array:
    """Compute the (200,) density of the errors over the bins of `EDGES`, with area 1 (paper 4.3.1)."""
    return np.asarray(np.histogram(errors, EDGES, density=True)[0], np.float64)


def distances(errors: Mapping[str, Array]) -> list[tuple[str, str, float]]:
    """Compute the Wasserstein distance between the errors of every two groups, without bins, in units of steering."""
    return [(one, two, float(wasserstein_distance(errors[one], errors[two]))) for one, two in combinations(errors, 2)]


@dataclass(frozen=True, kw_only=True)
class ErrorComparison:
    """Comparison of the errors on one sibling, or on all siblings, with those on the twin."""

    name: str  # name of the sibling, or `MERGED`
    images: int
    mean_squared: float
    beyond: float  # share of errors above `RANGE`, which the densities leave out
    distance: float  # Wasserstein distance of the densities, each at its bin's right edge (maxitwo)
    # Two-sided p-value of Wilcoxon's signed-rank test on the pairs of densities; None if all pairs are equal.
    p: float | None
    effect: float | None  # Cohen's d with pooled standard deviation; None if all errors are equal
    # Power of a two-sample t test on the errors; as in the authors' package, each sample has the size of both together.
    # None without an effect.
    power: float | None
    enough: float | None  # errors in each sample for a power of 0.8; None without an effect

    @property
    def alike(self) -> bool | None:
        """Whether the two are indistinguishable by the paper's rule: p above 0.05, and sufficient power."""
        if self.p is None or self.power is None:
            return None
        return self.p > ALPHA and self.power >= POWER


@dataclass(frozen=True)
class ErrorRobustnessCheck:
    """Comparison of a sibling's errors, or of `MERGED`, computed and tested as `what` says."""

    what: str
    name: str
    distance: float | None = None
    p: float | None = None
    power: float | None = None


def densities(errors: Array) -> Array:
    """Compute the density of the errors in 15 bins from 0 to 0.6, with area 1 over the errors up to 0.6 (maxitwo)."""
    counts = np.histogram(errors, BINS, (0.0, RANGE))[0]
    return counts / max(counts.sum(), 1) / (RANGE / BINS)


def shares(errors: Array) -> Array:
    """Compute the share of all errors in each bin (paper 4.3.1)."""
    return np.histogram(errors, BINS, (0.0, RANGE))[0] / len(errors)


def compare_errors(siblings: Mapping[str, Array], twin: Array) -> list[ErrorComparison]:
    """Compare each sibling's absolute steering errors, and those of all siblings together, with the twin's.

    The comparison is that of the authors' package (its compute_offline_metrics). `OpenLoopError` if there is no
    sibling, or if a simulator has no errors, or only errors above `RANGE`.
    """
    return [_compare(name, errors, twin) for name, errors in _with_merged(siblings, twin).items()]


def check_error_robustness(siblings: Mapping[str, Array], twin: Array) -> list[ErrorRobustnessCheck]:
    """Compare errors in other ways.

    `compare_errors` drops those above 0.6, tests 15 pairs of densities whatever the number of images, and counts each
    image twice.
    """
    groups, twin_shares, checks = _with_merged(siblings, twin), shares(twin), []
    for name, errors in groups.items():
        distance, p = _binned_distance(shares(errors), twin_shares), _wilcoxon(shares(errors), twin_shares)
        checks.append(ErrorRobustnessCheck("share of all errors per bin (paper 4.3.1)", name, distance, p))
    for name, errors in groups.items():
        distance, p = float(wasserstein_distance(errors, twin)), float(ks_2samp(errors, twin).pvalue)
        checks.append(ErrorRobustnessCheck("errors themselves, no bins; Kolmogorov-Smirnov test", name, distance, p))
    for name, errors in groups.items():
        power = _power(cohens_d(errors, twin), len(errors), len(twin) / len(errors))
        checks.append(ErrorRobustnessCheck("power with the true numbers of errors", name, power=power))
    return checks


def cohens_d(one: Array, other: Array) -> float | None:
    """Divide the difference of the means by the pooled standard deviation (Cohen 1988); None if that is 0."""
    n, m = len(one), len(other)
    if n + m < 3:
        return None
    pooled = math.sqrt(((n - 1) * _variance(one) + (m - 1) * _variance(other)) / (n + m - 2))
    return float(np.mean(one) - np.mean(other)) / pooled if pooled > 0 else None


def _variance(values: Array) -> float:
    return float(np.var(values, ddof=1)) if len(values) > 1 else 0.0


def _with_merged(siblings: Mapping[str, Array], twin: Array) -> dict[str, Array]:
    if not siblings:
        raise OpenLoopError("no sibling's errors to compare: expected at least one sibling")
    for name, errors in (*siblings.items(), ("the twin", twin)):
        if not errors.size:
            raise OpenLoopError(f"no image of {name} has an error to compare: expected recorded steering")
    return {**siblings, MERGED: np.concatenate(list(siblings.values()))}


def _compare(name: str, errors: Array, twin: Array) -> ErrorComparison:
    binned, twin_binned = densities(errors), densities(twin)
    effect = cohens_d(errors, twin)
    return ErrorComparison(
        name=name,
        images=len(errors),
        mean_squared=float(np.mean(errors**2)),
        beyond=float(np.mean(errors > RANGE)),
        distance=_binned_distance(binned, twin_binned),
        p=_wilcoxon(binned, twin_binned),
        effect=effect,
        power=_power(effect, len(errors) + len(twin), 1.0),
        enough=_enough(effect),
    )


def _binned_distance(one: Array, other: Array) -> float:
    """Compute the Wasserstein distance of weights at the right edges of the bins."""
    if not one.sum() or not other.sum():
        raise OpenLoopError(f"every error on one of the simulators is above {RANGE}: expected a network that can steer")
    ends = np.linspace(0.0, RANGE, BINS + 1)[1:]
    return float(wasserstein_distance(ends, ends, one, other))


def _wilcoxon(one: Array, other: Array) -> float | None:
    if np.array_equal(one, other):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SciPy warns if most pairs are equal; p is correct nevertheless
        return float(wilcoxon(one, other).pvalue)


# statsmodels is imported in the functions that use it: the import takes 1 s, and most commands do not need it.
def _power(effect: float | None, count: int, ratio: float) -> float | None:
    from statsmodels.stats.power import TTestIndPower

    if not effect or count < 2:
        return None
    power = float(TTestIndPower().power(effect, count, ALPHA, ratio=ratio))
    return power if math.isfinite(power) else None


def _enough(effect: float | None) -> float | None:
    from statsmodels.stats.power import tt_ind_solve_power

    if not effect:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # statsmodels warns if it does not converge; the result is None then
        try:
            count = float(np.squeeze(tt_ind_solve_power(effect_size=abs(effect), alpha=ALPHA, power=POWER, ratio=1.0)))
        except (ValueError, RuntimeError):
            return None
    return count if math.isfinite(count) and count > 0 else None
