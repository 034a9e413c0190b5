# SPDX-License-Identifier: Apache-2.0
"""How well road features and conditions predict failures, and what each sibling says beyond them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import rankdata

from ds_analysis.common.cross_validation import (
    FOLDS,
    REPEATS,
    SEED,
    Columns,
    auc_roc_by_ranks,
    best_feature,
    bits,
    folds_of,
    predict_failures,
    predict_with,
)
from ds_analysis.common.driven_road import GRID
from ds_analysis.common.outcome_table import OutcomeTable, RoadTable
from ds_analysis.common.statistics import (
    FEWEST_OF_EACH_KIND,
    Array,
    Bools,
    Indices,
    Interval,
    are_alone,
    interval_over_families,
    r_or_nan,
    splits_of,
)
from ds_base.words import listed
from ds_road.geometry import lane_curvature
from ds_sim.registry import SimulatorName


@dataclass(frozen=True, kw_only=True)
class Score:
    """Quality of cross-validated predictions; intervals are 95% bootstrap intervals over families of roads."""

    auc: float  # area under the ROC curve of the mean predicted probability; no interval where all resamples have 1
    auc_interval: Interval | None
    brier: float  # mean squared error of the probabilities; the share of failures p alone scores p (1 - p)
    brier_interval: Interval | None
    bits: float  # mean logarithmic loss, bits a road


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """How well road features and conditions predict the failures on one simulator.

    Attributes:
        entropy: entropy of the outcomes, bits a road: the loss if only the share of failures is known.
        best: the best single feature, chosen on other roads; None where failures are too few, by `caution`.
        chosen: name of the chosen feature -> share of the cross-validation's models in which it was chosen.
        all: a logistic model of all features; None likewise.
    """

    simulator: SimulatorName
    roads: int
    failures: int
    entropy: float
    best: Score | None
    chosen: Mapping[str, float]
    all: Score | None
    caution: str

    @property
    def feature(self) -> str:
        """Name of the feature that was chosen most often; "" if none was."""
        return max(self.chosen, key=lambda name: self.chosen[name], default="")


def caution_of_failures(table: OutcomeTable, simulator: SimulatorName) -> str:
    """Explain why failures are too few for a cross-validation; "" if they are not."""
    failed = table.failed(simulator)
    failures, roads = int(failed.sum()), len(failed)
    if min(failures, roads - failures) < FEWEST_OF_EACH_KIND:
        return (
            f"too few failures to say: {failures} of {roads} roads fail on {simulator}, expected {FEWEST_OF_EACH_KIND} "
            f"that fail and {FEWEST_OF_EACH_KIND} that do not"
        )
    kinds = [len(np.unique(table.families[failed == one])) for one in (True, False)]
    if min(kinds) < FOLDS:
        return (
            f"too few families to say: roads of {kinds[0]} families of mutants fail on {simulator}, of {kinds[1]} do "
            f"not, expected {FOLDS} of each kind"
        )
    return ""


def baseline_of(table: OutcomeTable, simulator: SimulatorName, *, repeats: int = REPEATS) -> Baseline:
    """Predict the failures on one simulator from road features and conditions alone."""
    failed = table.failed(simulator)
    share = float(failed.mean()) if len(failed) else 0.0
    entropy = -sum(p * float(np.log2(p)) for p in (share, 1.0 - share) if p > 0.0)
    caution = caution_of_failures(table, simulator)
    best = everything = None
    chosen: dict[str, float] = {}
    if not caution:
        best, counts = _score(table, failed, "best", repeats)
        everything, _ = _score(table, failed, "all", repeats)
        names = table.feature_names
        chosen = {names[k]: n / sum(counts.values()) for k, n in sorted(counts.items(), key=lambda kn: (-kn[1], kn[0]))}
    return Baseline(
        simulator=simulator,
        roads=len(failed),
        failures=int(failed.sum()),
        entropy=entropy,
        best=best,
        chosen=chosen,
        all=everything,
        caution=caution,
    )


def _score(table: OutcomeTable, failed: Bools, columns: Columns, repeats: int) -> tuple[Score, Mapping[int, int]]:
    prediction = predict_failures(table.features, failed, families=table.families, columns=(columns,), repeats=repeats)
    probability, truth = prediction.probability.mean(axis=0), failed.astype(np.float64)
    squared = np.asarray(((prediction.probability - failed) ** 2).mean(axis=0), np.float64)
    score = Score(
        auc=_auc(probability, truth),
        auc_interval=interval_over_families((probability, truth), _auc, table.families),
        brier=float(squared.mean()),
        brier_interval=interval_over_families((squared,), np.mean, table.families),
        bits=float(bits(prediction.probability, failed).mean()),
    )
    return score, prediction.chosen


def _auc(probability: Array, truth: Array) -> float:
    """AUC-ROC; NaN where all outcomes are the same, as in some resamples."""
    return float(auc_roc_by_ranks(probability, truth > 0.0)) if 0 < truth.sum() < len(truth) else float("nan")


@dataclass(frozen=True, kw_only=True)
class AddedInformation:
    """What one sibling adds about the failures on another simulator.

    Attributes:
        sibling: its outcome and largest lateral position are added to the predictors.
        beyond: siblings whose outcomes are among the predictors already, besides road features and conditions.
        left: bits a road that these predictors leave: mean logarithmic loss on roads that the model has not seen.
        bits: reduction of that loss, bits a road; None where failures are too few, by `caution`.
        interval: 95% interval of the reduction, by a paired bootstrap over families.
    """

    about: str
    sibling: SimulatorName
    beyond: tuple[str, ...]
    left: float | None = None
    bits: float | None = None
    interval: Interval | None = None
    caution: str = ""

    @property
    def verdict(self) -> str:
        """`adds information` if the interval lies above 0, `nothing shown`, or `too few`."""
        if self.bits is None:
            return "too few"
        return "adds information" if self.interval is not None and self.interval[0] > 0.0 else "nothing shown"

    @property
    def sentence(self) -> str:
        """What was found, in one line."""
        beyond = listed(["features", *self.beyond])
        if self.bits is None:
            return f"what {self.sibling} adds about {self.about} beyond {beyond}: {self.caution}"
        ends = f" ({self.interval[0]:z.3f} to {self.interval[1]:z.3f})" if self.interval else ""
        return f"{self.sibling} adds {self.bits:z.3f} bits{ends} about {self.about} beyond {beyond}: {self.verdict}"


def information_about(
    table: OutcomeTable, about: SimulatorName, siblings: Sequence[SimulatorName], *, repeats: int = REPEATS
) -> list[AddedInformation]:
    """Compute what each sibling adds about one simulator's failures, one after the other, in their order."""
    failed = table.failed(about)
    if caution := caution_of_failures(table, about):
        return [
            AddedInformation(about=about, sibling=name, beyond=tuple(siblings[:k]), caution=caution)
            for k, name in enumerate(siblings)
        ]
    predictions = predict_failures(table.features, failed, families=table.families, repeats=repeats)
    losses = bits(predictions.probability, failed)
    driven: list[Array] = []
    information = []
    for k, name in enumerate(siblings):
        # The largest lateral position is half a lane minus the fitness.
        driven += [table.failed(name).astype(np.float64), table.largest_lateral(name)]
        reduced = bits(predict_with(predictions, failed, np.column_stack(driven)), failed)
        gained = losses - reduced
        information.append(
            AddedInformation(
                about=about,
                sibling=name,
                beyond=tuple(siblings[:k]),
                left=float(losses.mean()),
                bits=float(gained.mean()),
                interval=interval_over_families((gained,), np.mean, table.families),
            )
        )
        losses = reduced
    return information


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
    """Compute the residual correlations of every pair of simulators; what features explain is fitted on other roads."""
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
