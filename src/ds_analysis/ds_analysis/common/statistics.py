# SPDX-License-Identifier: Apache-2.0
"""Statistics of maps over the cells that both fill, and of families of tests, with their bootstrap intervals."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import DegenerateDataWarning, bootstrap

from ds_base.intervals import LEVEL
from ds_road import Road
from ds_road.generation import GENES

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]
Interval = tuple[float, float]

RESAMPLES = 1000
"""Resamples of a bootstrap; chosen: ends of an interval are accurate to about a tenth of its width, in 1 s."""

NO_WIDTH = 1e-9
"""Width below which an interval is a single point; chosen: far above rounding errors, far below the digits shown."""

FEWEST_OF_EACH_KIND = 10
"""Cells in which the twin fails, and cells in which it does not, that a conclusion needs: ten events per predictor, as
with fewer, estimates are biased and intervals too narrow (Peduzzi et al., J. Clin. Epidemiol. 1996, 49(12))."""


def caution_of(cells: int, failing: int) -> str:
    """Explain why a comparison of so many cells, of which some fail, allows no conclusion; "" if it allows one."""
    if min(failing, cells - failing) >= FEWEST_OF_EACH_KIND:
        return ""
    return (
        f"the twin fails in {failing} of {cells} cells; a conclusion needs {FEWEST_OF_EACH_KIND} cells that fail and "
        f"{FEWEST_OF_EACH_KIND} that do not"
    )


def has_both_outcomes(truth: Array) -> bool:
    """Check whether some cells fail and some do not (paper 4.3.2: a cell fails if its probability is above 0)."""
    return bool((truth > 0).any() and not (truth > 0).all())


def auc_prc_or_reason(predicted: Array, truth: Array) -> tuple[float | None, str]:
    """Compute the AUC-PRC, or the reason why it is undefined."""
    if has_both_outcomes(truth):
        return auc_prc(predicted, truth), ""
    if not len(truth):
        return None, "no cells in common"
    return None, f"the twin fails in {'every cell' if (truth > 0).all() else 'no cell'}"


def ranks(predicted: Array) -> tuple[Indices, Indices]:
    """Order that sorts predictions, the largest first, and where in it each run of equal ones ends."""
    order = np.argsort(-predicted, kind="stable")
    return order, np.flatnonzero(np.append(np.diff(predicted[order]) != 0.0, True))


def auc_prc(predicted: Array, truth: Array) -> float:
    """Compute the AUC-PRC of (cells,) values for the twin's rates; same bits as scikit-learn's average precision."""
    order, ends = ranks(predicted)
    hits = np.cumsum(truth[order] > 0.0)[ends].astype(np.float64)
    recall = np.append((hits / hits[-1])[::-1], 0.0)
    return max(0.0, -float(np.sum(np.diff(recall) * (hits / (ends + 1.0))[::-1])))


def r_or_nan(predicted: Array, truth: Array) -> float:
    """Compute Pearson's r of a resample, NaN if one of the values is constant; `pearsonr` takes ten times as long."""
    return float(np.corrcoef(predicted, truth)[0, 1]) if np.ptp(predicted) and np.ptp(truth) else float("nan")


def auc_prc_or_nan(predicted: Array, truth: Array) -> float:
    """Compute the AUC-PRC of a resample, NaN if all its cells fail or none does."""
    return auc_prc(predicted, truth) if has_both_outcomes(truth) else float("nan")


def bootstrap_interval(
    samples: tuple[Array, ...], statistic: Callable[..., float], resamples: int
) -> tuple[float, float] | None:
    """Estimate a percentile interval by a bootstrap over cells; equal values give equal intervals.

    None without resamples, and if the statistic is 1 (or -1) in all of them, as of a degenerate sample.
    """
    if not resamples:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateDataWarning)
        interval = bootstrap(
            samples,
            statistic,
            paired=True,
            vectorized=False,
            n_resamples=resamples,
            method="percentile",
            rng=np.random.default_rng(len(samples[0])),
        )
    defined = interval.bootstrap_distribution[~np.isnan(interval.bootstrap_distribution)]
    if not len(defined):
        return None
    low, high = np.quantile(defined, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    if high - low < NO_WIDTH and abs(abs(high) - 1.0) < NO_WIDTH:
        return None
    return float(low), float(high)


def families_of(roads: Sequence[Road]) -> Indices:
    """(tests,) number of each test's family, from 0 in the order of first appearance: the root of mutation of its road.

    Mutation moves the control points `GENES` alone (`ds_road.mutate`), or a condition. The others stay bit for bit
    those of the root, which differ between random roads: equal ones tell a family, and no pedigree need be stored.
    """
    numbers: dict[object, int] = {}
    return np.array([numbers.setdefault(_kept_by_mutation(road), len(numbers)) for road in roads], np.intp)


def are_alone(families: Indices) -> bool:
    """Whether every test is a family of its own, as random roads are."""
    return len(np.unique(families)) == len(families)


def splits_of(families: Indices, parts: int, seed: int) -> Iterator[tuple[Indices, Indices]]:
    """Yield training and test indices of families that are divided at random into parts, at most one each family."""
    distinct, family = np.unique(families, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(distinct))
    member = (order % min(parts, len(distinct)))[family]
    for part in np.unique(member):
        yield np.flatnonzero(member != part), np.flatnonzero(member == part)


def interval_over_families(
    samples: tuple[NDArray[np.float64], ...], statistic: Callable[..., float], families: Indices
) -> tuple[float, float] | None:
    """`bootstrap_interval` of a statistic of (tests,) samples over families; None for a single one."""
    if len(np.unique(families)) < 2:
        return None
    if are_alone(families):
        return bootstrap_interval(samples, statistic, RESAMPLES)
    rows = [np.flatnonzero(families == one) for one in np.unique(families)]

    def of_families(drawn: NDArray[np.float64]) -> float:
        picked = np.concatenate([rows[int(k)] for k in drawn])
        return statistic(*(values[picked] for values in samples))

    return bootstrap_interval((np.arange(len(rows), dtype=np.float64),), of_families, RESAMPLES)


def _kept_by_mutation(road: Road) -> object:
    if road.sampled:
        return road.road_id  # has no control points to move
    return road.lane, tuple(point for k, point in enumerate(road.control_points) if k not in GENES)
