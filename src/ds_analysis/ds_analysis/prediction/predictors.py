# SPDX-License-Identifier: Apache-2.0
"""Scores predictors of a twin that was driven, none of which saw its outcomes; all have to beat the features alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ds_analysis.common.cross_validation import FOLDS, SEED, STRENGTHS, bounded, standardised
from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError
from ds_analysis.common.statistics import (
    FEWEST_OF_EACH_KIND,
    NO_WIDTH,
    RESAMPLES,
    Array,
    Indices,
    Interval,
    auc_prc_or_reason,
    splits_of,
)
from ds_analysis.prediction.mixture import Prediction
from ds_base.intervals import LEVEL, jeffreys_interval
from ds_base.table import Column, Table
from ds_orchestrator.maps.algebra import OPERATORS
from ds_sim.registry import SimulatorName


def features_alone(table: OutcomeTable) -> Array:
    """(tests,) probabilities of failure by a logistic model of siblings' outcomes on tests of other families.

    `OutcomeTableError` if there are no other families.
    """
    from sklearn import config_context

    known, failed = table.sibling_verdicts
    counts = np.column_stack((failed.sum(axis=1), (known & ~failed).sum(axis=1))).astype(np.float64)
    driven = np.flatnonzero(counts.sum(axis=1) > 0)
    if len(np.unique(table.families[driven])) < 2:
        raise OutcomeTableError("all tests descend from one road: expected two families of tests, or more")
    with config_context(assume_finite=True, skip_parameter_validation=True):
        probabilities = np.empty(len(table))
        for others, test in splits_of(table.families, FOLDS, SEED):
            train = np.intersect1d(others, driven)
            strength = _chosen(table.features[train], counts[train], table.families[train])
            probabilities[test] = _fitted(strength, table.features[train], counts[train], table.features[test])
    return probabilities


def _chosen(features: Array, counts: Array, families: Indices) -> float:
    """Inverse strength of the ridge penalty with the smallest loss on other families, the first of equal ones."""
    splits = list(splits_of(families, FOLDS, SEED + 1))
    if len(splits) < 2:
        return 1.0
    losses = []
    for strength in STRENGTHS:
        loss = 0.0
        for train, test in splits:
            probability = _fitted(strength, features[train], counts[train], features[test])
            loss -= float(counts[test, 0] @ np.log(probability) + counts[test, 1] @ np.log(1.0 - probability))
        losses.append(round(loss, 9))
    return STRENGTHS[int(np.argmin(losses))]


def _fitted(strength: float, features: Array, counts: Array, others: Array) -> Array:
    """Fit a model to failures and successes of training tests, and predict other tests."""
    from sklearn.linear_model import LogisticRegression

    total = counts.sum()
    if not counts.sum(axis=0).all():  # all failed, or none
        return bounded(np.full(len(others), counts[:, 0].sum() / total), int(total))
    train, test = standardised(features, others)
    fit = LogisticRegression(C=strength, solver="newton-cholesky").fit(
        np.vstack((train, train)),
        np.repeat((1, 0), len(train)),
        sample_weight=np.concatenate((counts[:, 0], counts[:, 1])),
    )
    return bounded(fit.predict_proba(test)[:, 1], int(total))


FEATURES, MODEL = "features alone", "prediction"
"""Names of the baseline, and of what `ds predict` says."""
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
"""Edges of the reliability table's bins; chosen: narrow at the ends, where a probability decides something."""
_SEED = 18
"""Seed of the bootstrap; any number does."""


@dataclass(frozen=True)
class PredictorScore:
    """Score of one predictor; intervals are 95% bootstrap intervals over families of tests.

    Attributes:
        predictor: a sibling, a merge operator, `FEATURES` or `MODEL`.
        difference: Brier score minus that of the features alone: negative is better. None for these themselves.
        average_precision: AUC-PRC; None if all tests have the same outcome.
        verdict: `adds` to the features alone, is `worse`, `adds nothing`, or `too few` tests say.
    """

    predictor: str
    brier: float
    brier_interval: Interval | None
    difference: float | None
    difference_interval: Interval | None
    average_precision: float | None
    verdict: str


@dataclass(frozen=True, kw_only=True)
class PredictorComparison:
    """Every predictor of one twin's failures.

    Attributes:
        tests: number of tests with a verdict everywhere; of them, `failures` fail on the twin.
        reliability: of the prediction: bin's edges, tests, mean probability, share that failed and its interval.
    """

    twin: SimulatorName
    tests: int
    families: int
    failures: int
    scores: Sequence[PredictorScore]
    reliability: Sequence[tuple[float, float, int, float, float, Interval]]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return asdict(self)


def compare_predictors(table: OutcomeTable, prediction: Prediction) -> PredictorComparison:
    """Score every predictor of the twin's failures, by test; the prediction has no drives of the twin.

    Raises:
        OutcomeTableError: there is no twin, or no test with a verdict everywhere.
    """
    if table.twin is None:
        raise OutcomeTableError(
            "there is no twin to compare predictions with: name a simulator that plays it, as in --twin "
            f"{table.siblings[-1]}"
        )
    rows = np.flatnonzero(table.on_siblings & table.known(table.twin))
    if not len(rows):
        raise OutcomeTableError(
            f"no test has a verdict on every sibling and on {table.twin}: let the campaign drive the twin first"
        )
    kept = table.select(rows)
    truth = kept.failed(table.twin).astype(np.float64)
    driven: dict[str, Array] = {name: kept.failed(name).astype(np.float64) for name in kept.siblings}
    model = prediction.probabilities(rows)
    predicted = {**driven, **merged(list(driven.values())), FEATURES: features_alone(table)[rows], MODEL: model}
    weights = _family_weights(kept.families)
    baseline = _brier(predicted[FEATURES], truth, weights)
    few = min(truth.sum(), len(truth) - truth.sum()) < FEWEST_OF_EACH_KIND
    scored = []
    for name, probability in predicted.items():
        squared = _brier(probability, truth, weights)
        precision = auc_prc_or_reason(probability, truth)[0]
        difference, ends, verdict = None, None, "baseline"
        if name != FEATURES:
            other = squared - baseline
            difference, ends = float(other[0]), _interval(other)
            low, high = ends or (0.0, 0.0)
            adds = "adds" if high < 0.0 else "worse" if low > 0.0 else "adds nothing"
            verdict = "too few" if few else adds
        brier = float(squared[0]), _interval(squared)
        scored.append(PredictorScore(name, *brier, difference, ends, precision, verdict))
    return PredictorComparison(
        twin=table.twin,
        tests=len(rows),
        families=len(np.unique(kept.families)),
        failures=int(truth.sum()),
        scores=scored,
        reliability=_reliability(model, truth),
    )


def _family_weights(families: Indices) -> Array:
    """(`RESAMPLES` + 1, rows) weights in a bootstrap over families, the sample first (Davison, Hinkley 1997, 3.8)."""
    distinct, member = np.unique(families, return_inverse=True)
    rng = np.random.default_rng(_SEED)
    drawn = rng.multinomial(len(distinct), np.full(len(distinct), 1.0 / len(distinct)), size=RESAMPLES)
    return np.asarray(np.vstack((np.ones(len(distinct)), drawn))[:, member])


def _brier(predicted: Array, truth: Array, weights: Array) -> Array:
    """(resamples,) mean squared error of probabilities (Brier 1950)."""
    return np.asarray(weights @ (predicted - truth) ** 2 / weights.sum(axis=1))


def _interval(scores: Array) -> Interval | None:
    """95% percentile interval of a score's resamples; None where all are the same, as the sample is degenerate."""
    low, high = np.quantile(scores[1:], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return None if high - low < NO_WIDTH else (float(low), float(high))


def _reliability(probability: Array, truth: Array) -> list[tuple[float, float, int, float, float, Interval]]:
    bins = np.clip(np.digitize(probability, BINS[1:-1]), 0, len(BINS) - 2)
    scores = []
    for k in np.unique(bins):
        of = truth[bins == k]
        share, ends = float(of.mean()), jeffreys_interval(int(of.sum()), len(of))
        scores.append((BINS[k], BINS[k + 1], len(of), float(probability[bins == k].mean()), share, ends))
    return scores


def merged(driven: list[Array]) -> dict[str, Array]:
    """Every operator on the siblings' values; all siblings drove all tests, so weights are equal."""
    weights = np.ones(len(driven))
    return {name: operator.combine(np.array(driven), weights) for name, operator in OPERATORS.items()}


def comparison_tables(comparison: PredictorComparison) -> list[Table]:
    """Tabulate a comparison: scores, then reliability."""
    names = ("predictor", "Brier", "95 %", "minus features alone", "95 % of it", "AUC-PRC", "verdict")
    text = {"predictor", "verdict"}
    bins = ("from", "to", "tests", "predicted", "failed", "95 %")
    return [
        Table(
            name="predictors",
            title=f"Failures on {comparison.twin} predicted without driving it: {comparison.failures} of "
            f"{comparison.tests} tests, {comparison.families} families",
            columns=[Column(name, "text" if name in text else "number") for name in names],
            rows=[tuple(asdict(one).values()) for one in comparison.scores],
            notes=[
                "A predictor adds to the features alone if the 95% interval of the difference lies below 0; intervals "
                f"resample whole families of tests. With fewer than {FEWEST_OF_EACH_KIND} tests that fail, or that do "
                "not, nothing is concluded."
            ],
        ),
        Table(
            name="predictor_reliability",
            title=f"Predicted probabilities and failures on {comparison.twin}",
            columns=[Column(name, "count" if name == "tests" else "number") for name in bins],
            rows=list(comparison.reliability),
        ),
    ]
