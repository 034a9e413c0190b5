# SPDX-License-Identifier: Apache-2.0
"""Correlation of two simulators' lateral positions after what road features explain is taken out.

That is fitted on other roads (cross-fitting), by isotonic regression, which assumes nothing but a direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import rankdata

from ds_analysis.common.cross_validation import FOLDS, REPEATS, SEED, best_feature, folds_of
from ds_analysis.common.driven_road import GRID
from ds_analysis.common.outcome_table import RoadTable
from ds_analysis.common.statistics import (
    FEWEST_OF_EACH_KIND,
    Array,
    Indices,
    Interval,
    are_alone,
    interval_over_families,
    r_or_nan,
    splits_of,
)
from ds_analysis.siblings.added_information import caution_of_failures
from ds_road.geometry import lane_curvature
from ds_sim.registry import SimulatorName

FEWEST_ROADS = 2 * FEWEST_OF_EACH_KIND
"""Roads that a correlation over roads needs; chosen: as many as the rule for failures needs in all."""


@dataclass(frozen=True)
class ResidualCorrelation:
    """Correlation of two simulators' lateral positions; intervals are 95% bootstrap intervals over families of roads.

    Attributes:
        plain: Pearson r of the largest absolute lateral positions, over roads.
        roads: the same after each simulator's best single feature, of other roads, is taken out; None where failures
            are too few to choose one.
        places: r of the lateral positions at the same places, after the curvature there is taken out.
        caution: why a number is missing, or "".
    """

    first: str
    second: str
    plain: float | None
    plain_interval: Interval | None
    roads: float | None
    roads_interval: Interval | None
    places: float | None
    places_interval: Interval | None
    caution: str


def residual_correlations(table: RoadTable, *, repeats: int = REPEATS) -> list[ResidualCorrelation]:
    """Compute the residual correlations of every pair of simulators, in their order."""
    lateral = {name: table.largest_lateral(name) for name in table.simulators}
    cautions = {name: caution_of_failures(table, name) for name in table.simulators}
    by_road = {name: None if cautions[name] else _road_residuals(table, name, repeats) for name in table.simulators}
    by_place = _place_residuals(table)
    correlations = []
    for first, second in combinations(table.simulators, 2):
        plain = _correlation(lateral[first], lateral[second], table.families)
        one, other = by_road[first], by_road[second]
        roads = (None, None) if one is None or other is None else _correlation(one, other, table.families)
        places = _clustered_correlation(by_place[first], by_place[second], table.families)
        few = f"{len(table.roads)} roads, expected {FEWEST_ROADS}" if len(table.roads) < FEWEST_ROADS else ""
        caution = "; ".join(filter(None, (few, cautions[first], cautions[second])))
        correlations.append(ResidualCorrelation(first, second, *plain, *roads, *places, caution))
    return correlations


def _road_residuals(table: RoadTable, simulator: SimulatorName, repeats: int) -> Array:
    """Largest lateral positions minus what the best single feature predicts, (roads,), m; mean over the repeats."""
    failed, lateral, features = table.failed(simulator), table.largest_lateral(simulator), table.features
    residuals = np.empty((repeats, len(lateral)))
    for repeat in range(repeats):
        for train, test in folds_of(failed, table.families, SEED + repeat):
            used = features[:, best_feature(features[train], failed[train])]
            residuals[repeat, test] = lateral[test] - _isotonic(used[train], lateral[train], used[test])
    return np.asarray(residuals.mean(axis=0))


def _place_residuals(table: RoadTable) -> dict[str, list[Array]]:
    """Per simulator and road the lateral positions minus what the curvature at the place predicts, m."""
    longest = [
        max((len(table.profiles[name][k]) for name in table.simulators), default=0) for k in range(len(table.roads))
    ]
    curvatures = [
        lane_curvature(road.lane_centre, np.arange(1.0, count + 1.0) * GRID)
        for road, count in zip(table.roads, longest, strict=True)
    ]
    by_simulator: dict[str, list[Array]] = {}
    for name in table.simulators:
        profiles = table.profiles[name]
        residuals = [np.empty(0)] * len(profiles)
        for train, test in _parts(table.families):
            x, at = (
                np.concatenate([np.empty(0), *(curvatures[k][: len(profiles[k])] for k in part)])
                for part in (train, test)
            )
            y = np.concatenate([np.empty(0), *(profiles[k] for k in train)])
            if not len(x) or not len(at):
                continue
            predicted = np.split(_isotonic(x, y, at), np.cumsum([len(profiles[k]) for k in test])[:-1])
            for k, expected in zip(test, predicted, strict=True):
                residuals[k] = profiles[k] - expected
        by_simulator[name] = residuals
    return by_simulator


def _parts(families: Indices) -> list[tuple[Indices, Indices]]:
    """Divide roads into `FOLDS` parts, in no order, each family in one of them; training and test indices."""
    if not are_alone(families):
        return list(splits_of(families, FOLDS, SEED))
    order = np.random.default_rng(SEED).permutation(len(families))
    return [(np.setdiff1d(order, part), np.sort(part)) for part in np.array_split(order, FOLDS)]


def _isotonic(x: Array, y: Array, at: Array) -> Array:
    """Fit a monotone function, rising or falling as Spearman's rank correlation has it, and predict others by it."""
    from sklearn.isotonic import IsotonicRegression

    rising = not r_or_nan(np.asarray(rankdata(x)), np.asarray(rankdata(y))) < 0.0
    return np.asarray(IsotonicRegression(increasing=rising, out_of_bounds="clip").fit(x, y).predict(at))


def _correlation(one: Array, other: Array, families: Indices) -> tuple[float | None, Interval | None]:
    if len(one) < FEWEST_ROADS or not np.ptp(one) or not np.ptp(other):
        return None, None
    return r_or_nan(one, other), interval_over_families((one, other), r_or_nan, families)


def _clustered_correlation(
    ones: Sequence[Array], others: Sequence[Array], families: Indices
) -> tuple[float | None, Interval | None]:
    """Pearson r over all places of all roads, and its interval over families, from sums per road."""
    sums = np.array([_sums(one, other) for one, other in zip(ones, others, strict=True)]).reshape(-1, 6)
    if (sums[:, 0] > 0).sum() < FEWEST_ROADS:
        return None, None
    correlation = _of_sums(*sums.T)
    if np.isnan(correlation):
        return None, None
    return correlation, interval_over_families(tuple(sums.T), _of_sums, families)


def _sums(one: Array, other: Array) -> tuple[float, ...]:
    both = min(len(one), len(other))
    x, y = one[:both], other[:both]
    return float(both), float(x.sum()), float(y.sum()), float(x @ x), float(y @ y), float(x @ y)


def _of_sums(n: Array, x: Array, y: Array, xx: Array, yy: Array, xy: Array) -> float:
    """Pearson r from sums over the places of each road; NaN where it is not defined."""
    count, sum_x, sum_y = n.sum(), x.sum(), y.sum()
    spread = (count * xx.sum() - sum_x**2) * (count * yy.sum() - sum_y**2)
    return float((count * xy.sum() - sum_x * sum_y) / np.sqrt(spread)) if spread > 0.0 else float("nan")
