"""The undriven baseline: how well road features and conditions predict on which roads a driver fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ds_analysis.common.cross_validation import (
    FOLDS,
    REPEATS,
    Array,
    Columns,
    Outcome,
    auc_roc,
    bits,
    predict_failures,
)
from ds_analysis.common.families import interval_over_families
from ds_analysis.common.statistics import FEWEST_OF_EACH_KIND
from ds_analysis.siblings.outcomes import Outcomes

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Score:
    """Quality of cross-validated predictions; intervals are 95 % bootstrap intervals over families of roads.

    Attributes:
        auc: area under the ROC curve of the mean predicted probability: probability that a failing road is ranked
            above one that does not fail.
        auc_interval: its interval; None where all resamples have an area of 1.
        brier: Brier score, the mean squared error of the probabilities; the share of failures p alone scores p (1 - p).
        brier_interval: its interval.
        bits: mean logarithmic loss, bits a road: what the outcomes still surprise by.
    """

    auc: float
    auc_interval: Interval | None
    brier: float
    brier_interval: Interval | None
    bits: float


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """How well road features and conditions predict the failures on one simulator.

    Attributes:
        simulator: name of the simulator.
        roads: number of roads.
        failures: number of them on which the driver fails.
        entropy: entropy of the outcomes, bits a road: what they surprise by if only the share of failures is known.
        best: the best single feature, chosen on other roads; None where failures are too few.
        chosen: name of the chosen feature -> share of the cross-validation's models in which it was chosen.
        all: a logistic model of all features; None where failures are too few.
        caution: why there are no scores, or "".
    """

    simulator: str
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


def caution_of_failures(outcomes: Outcomes, simulator: str) -> str:
    """Explain why failures are too few for a prediction; "" if they are not.

    See `FEWEST_OF_EACH_KIND`; each part of the cross-validation needs a family of each kind.
    """
    failed = outcomes.failures(simulator)
    failures, roads = int(failed.sum()), len(failed)
    if min(failures, roads - failures) < FEWEST_OF_EACH_KIND:
        return (
            f"too few failures to say: {failures} of {roads} roads fail on {simulator}, expected {FEWEST_OF_EACH_KIND} "
            f"that fail and {FEWEST_OF_EACH_KIND} that do not"
        )
    kinds = [len(np.unique(outcomes.families[failed == one])) for one in (True, False)]
    if min(kinds) < FOLDS:
        return (
            f"too few families to say: roads of {kinds[0]} families of mutants fail on {simulator}, of {kinds[1]} do "
            f"not, expected {FOLDS} of each kind"
        )
    return ""


def baseline_of(outcomes: Outcomes, simulator: str, *, repeats: int = REPEATS) -> Baseline:
    """Predict the failures on one simulator from road features and conditions alone."""
    failed = outcomes.failures(simulator)
    share = float(failed.mean()) if len(failed) else 0.0
    entropy = -sum(p * float(np.log2(p)) for p in (share, 1.0 - share) if p > 0.0)
    caution = caution_of_failures(outcomes, simulator)
    best = everything = None
    chosen: dict[str, float] = {}
    if not caution:
        best, counts = _score(outcomes, failed, "best", repeats)
        everything, _ = _score(outcomes, failed, "all", repeats)
        names = outcomes.feature_names
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


def _score(outcomes: Outcomes, failed: Outcome, columns: Columns, repeats: int) -> tuple[Score, Mapping[int, int]]:
    found = predict_failures(outcomes.features, failed, families=outcomes.families, columns=(columns,), repeats=repeats)
    probability, truth = found.probability.mean(axis=0), failed.astype(np.float64)
    squared = np.asarray(((found.probability - failed) ** 2).mean(axis=0), np.float64)
    score = Score(
        auc=_auc(probability, truth),
        auc_interval=interval_over_families((probability, truth), _auc, outcomes.families),
        brier=float(squared.mean()),
        brier_interval=interval_over_families((squared,), _mean, outcomes.families),
        bits=float(bits(found.probability, failed).mean()),
    )
    return score, found.chosen


def _auc(probability: Array, truth: Array) -> float:
    """AUC-ROC; NaN where all outcomes are the same, as in some resamples."""
    return float(auc_roc(probability, truth > 0.0)) if 0 < truth.sum() < len(truth) else float("nan")


def _mean(values: Array) -> float:
    return float(values.mean())
