# SPDX-License-Identifier: Apache-2.0
"""Measures how differently simulators behave with the same driver on the same roads (complementarity, paper 3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from statsmodels.stats.inter_rater import cohens_kappa

from ds_analysis.common.driven_road import DrivenRoad
from ds_analysis.common.outcome_table import RoadTable
from ds_analysis.common.statistics import Array, r_or_nan
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome

APART = 0.5
"""Distance from which two lateral positions count as apart, m; chosen: a quarter of half a lane."""


@dataclass(frozen=True)
class PairComparison:
    """Comparison of two simulators on the same roads.

    Attributes:
        roads: number of roads on which both runs ended with a verdict.
        kappa: Cohen's kappa of the verdicts; None if undefined, by `reason`.
        kappa_interval: asymptotic 95% interval of kappa (statsmodels), clipped to [-1, 1].
        median_apart: median distance of the lateral positions over all places, m; then 95th percentile, and largest.
        share_apart: share of places at which they are more than `APART` apart.
        correlation: Pearson r of the lateral positions over all places; None if one is constant.
    """

    first: str
    second: str
    roads: int
    both_fail: int
    only_first_fails: int
    only_second_fails: int
    both_complete: int
    kappa: float | None
    kappa_interval: tuple[float, float] | None
    reason: str
    median_apart: float | None
    apart_95: float | None
    most_apart: float | None
    share_apart: float | None
    correlation: float | None


def compare(table: RoadTable) -> list[PairComparison]:
    """Compare every pair of simulators, in their order, on the tests with a verdict on both."""
    return [_pair(table, a, b) for a, b in combinations(table.simulators, 2)]


def summary(runs: Sequence[DrivenRoad]) -> dict[str, Any]:
    """Summarise outcomes and driving quality of one simulator, as JSON values."""
    judged = [run for run in runs if run.outcome.is_verdict]
    failures = sum(run.outcome.is_failure for run in judged)
    return {
        "roads": len(judged),
        "errors": len(runs) - len(judged),
        "failures": failures,
        "success_rate": (len(judged) - failures) / len(judged) if judged else None,
        "outcomes": {o.name: n for o in Outcome if (n := sum(run.outcome is o for run in runs))},
        "median_max_lateral_position": float(np.median([r.max_lateral_position for r in judged])) if judged else None,
    }


def most_different(table: RoadTable, count: int) -> list[int]:
    """Find the rows of the tests on which two simulators get farthest apart, the farthest first."""
    widest = [
        max((float(gap.max()) for a, b in combinations(at, 2) if len(gap := gaps(a, b))), default=0)
        for at in zip(*table.profiles.values(), strict=True)
    ]
    return sorted(range(len(table)), key=lambda i: (-widest[i], i))[:count]


def gaps(one: Array, other: Array) -> Array:
    """Compute the distance between two profiles, m, at the places that both cover."""
    both = min(len(one), len(other))
    return np.abs(one[:both] - other[:both])


def _pair(outcomes: RoadTable, first: SimulatorName, second: SimulatorName) -> PairComparison:
    judged = np.flatnonzero(outcomes.known(first) & outcomes.known(second)).tolist()
    failed, other_failed = outcomes.failed(first)[judged], outcomes.failed(second)[judged]
    table = np.zeros((2, 2), int)
    np.add.at(table, (failed.astype(int), other_failed.astype(int)), 1)
    pairs = [(outcomes.profiles[first][k], outcomes.profiles[second][k]) for k in judged]
    common = [min(map(len, pair)) for pair in pairs]
    ones, others = (
        np.concatenate([np.empty(0), *(pair[i][:both] for pair, both in zip(pairs, common, strict=True))])
        for i in (0, 1)
    )
    none, only_second, only_first, both = table.ravel().tolist()
    kappa, distances = _kappa(first, second, table), _distances(ones, others)
    return PairComparison(first, second, len(judged), both, only_first, only_second, none, *kappa, *distances)


def _distances(ones: Array, others: Array) -> tuple[float | None, ...]:
    """Median, 95th percentile and largest distance of lateral positions, share of those apart, and correlation."""
    if not len(ones):
        return (None,) * 5
    apart, correlation = np.abs(ones - others), r_or_nan(ones, others)
    sizes = np.median(apart), np.percentile(apart, 95), apart.max(), (apart > APART).mean()
    return (*map(float, sizes), None if math.isnan(correlation) else correlation)


def _kappa(
    first: SimulatorName, second: SimulatorName, table: NDArray[np.int_]
) -> tuple[float | None, tuple[float, float] | None, str]:
    """Compute Cohen's kappa of a table of verdicts (rows: first, columns: second) and its interval, or the reason."""
    if table.sum() == 0:
        return None, None, "no road was driven to a verdict on both"
    for name, counts in ((first, table.sum(axis=1)), (second, table.sum(axis=0))):
        if 0 in counts:
            verdict = "completes" if counts[1] == 0 else "fails"
            return None, None, f"{name} {verdict} every road: agreement beyond chance is not defined"
    agreement = cohens_kappa(table)
    # The asymptotic interval may leave kappa's range.
    interval = max(float(agreement.kappa_low), -1.0), min(float(agreement.kappa_upp), 1.0)
    return float(agreement.kappa), interval if all(map(math.isfinite, interval)) else None, ""
