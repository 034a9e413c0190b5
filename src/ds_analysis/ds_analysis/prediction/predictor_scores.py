"""Scores of every predictor of the twin's failures, with intervals over families and a verdict against the baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ds_analysis.common import weighted_scores as scores
from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import FEWEST_OF_EACH_KIND, RESAMPLES, Array, Interval
from ds_analysis.common.table import Column, Table
from ds_analysis.prediction.predictors import (
    HIERARCHICAL,
    SINGLE,
    UNDRIVEN,
    Predictions,
    comparable,
    modelled,
    predict_cells,
    predict_tests,
)
from ds_analysis.prediction.twin_prediction import TwinPrediction
from ds_orchestrator.maps.algebra import jeffreys_interval

THRESHOLDS = (0.5, 0.1)
"""Predicted probabilities from which a test or cell is called failing: more likely than not, and one in ten, where a
cautious user would look; both chosen before any result was seen."""
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
"""Edges of the reliability diagram's bins; chosen: narrow at the ends, where a probability decides something."""
_PERFECT = 0.9999
"""Correlation beyond which a drive's worth is not said: no sample shows it."""
_SEED = 18
"""Seed of the bootstrap; any number does."""


@dataclass(frozen=True, kw_only=True)
class PredictorScore:
    """Scores of one predictor; intervals are 95 % bootstrap intervals over families of tests.

    Attributes:
        level: `test` or `cell`.
        predictor: name.
        rows: number of tests or cells.
        families: number of families that are resampled.
        brier: mean squared error.
        brier_interval: its interval.
        difference: Brier score minus that of the undriven features: negative is better. None for these themselves.
        difference_interval: its interval.
        log_loss: mean logarithmic loss, bits; probabilities are kept 1 / (n + 2) away from 0 and 1.
        recall: per threshold, share of failing rows that are called failing; a cell fails if the twin fails in it.
        false_alarms: per threshold, share of rows that do not fail but are called failing.
        average_precision: AUC-PRC.
        average_precision_interval: its interval.
        r: Pearson's r with the twin's outcomes or rates.
        r_interval: its interval.
        caution: why the scores carry no conclusion, or "".
    """

    level: str
    predictor: str
    rows: int
    families: int
    brier: float
    brier_interval: Interval | None
    difference: float | None
    difference_interval: Interval | None
    log_loss: float
    recall: tuple[float | None, ...]
    false_alarms: tuple[float | None, ...]
    average_precision: float | None
    average_precision_interval: Interval | None
    r: float | None
    r_interval: Interval | None
    caution: str

    @property
    def worth(self) -> float | None:
        """Real drives without the prediction that one drive with it is worth, for estimating a failure rate.

        As a control variate, a prediction leaves a share 1 - r^2 of the variance (Sim2Val; prediction-powered
        inference, Angelopoulos et al., Science 2023).
        """
        return None if self.r is None or abs(self.r) > _PERFECT else 1.0 / (1.0 - self.r**2)

    @property
    def verdict(self) -> str:
        """What the predictor adds to the undriven features."""
        if self.difference is None:
            return "baseline"
        if self.predictor == SINGLE:
            return "undriven"
        if self.caution:
            return "too few"
        low, high = self.difference_interval or (0.0, 0.0)
        return "adds" if high < 0.0 else "worse" if low > 0.0 else "adds nothing"


@dataclass(frozen=True, kw_only=True)
class ReliabilityBin:
    """Tests whose predicted probability lies in one bin.

    Attributes:
        predictor: name.
        low: lower edge.
        high: upper edge.
        tests: number of tests.
        predicted: mean predicted probability.
        observed: share of them that failed on the twin.
        interval: 95 % Jeffreys interval of that share.
    """

    predictor: str
    low: float
    high: float
    tests: int
    predicted: float
    observed: float
    interval: Interval


@dataclass(frozen=True, kw_only=True)
class PredictorComparison:
    """Every predictor of one twin's failures.

    Attributes:
        twin: simulator that plays the twin.
        siblings: the others.
        scores: per test, then per cell.
        reliability: of the models, per test.
    """

    twin: str
    siblings: Sequence[str]
    scores: Sequence[PredictorScore]
    reliability: Sequence[ReliabilityBin]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "twin": self.twin,
            "siblings": list(self.siblings),
            "thresholds": list(THRESHOLDS),
            "scores": [{**asdict(one), "worth": one.worth, "verdict": one.verdict} for one in self.scores],
            "reliability": [asdict(one) for one in self.reliability],
        }


def compare_predictors(table: OutcomeTable, prediction: TwinPrediction | None = None) -> PredictorComparison:
    """Score every predictor of the twin's failures.

    Args:
        table: outcomes.
        prediction: of the hierarchical model without drives of the twin, if it is known already.

    Raises:
        ds_analysis.common.outcome_table.OutcomeTableError: there is no twin, or too few tests.
    """
    rows = comparable(table)
    models = {name: values[rows] for name, values in modelled(table, prediction).items()}
    kept = table.select(rows)
    weights = scores.family_weights(kept.families, RESAMPLES, _SEED)
    families = len(np.unique(kept.families))
    by_test = predict_tests(kept, models, weights)
    levels = [by_test]
    if any(cell is not None for cell in kept.cells):
        levels.append(predict_cells(kept, models, weights))
    return PredictorComparison(
        twin=str(table.twin),
        siblings=table.siblings,
        scores=[one for level in levels for one in _scores(level, families)],
        reliability=[one for name in (UNDRIVEN, HIERARCHICAL) for one in _reliability(by_test, name)],
    )


def _scores(predictions: Predictions, families: int) -> list[PredictorScore]:
    truth, weights = predictions.truth, predictions.weights
    failing = (truth > 0.0).astype(np.float64)
    of_sample = failing if failing.ndim == 1 else failing[0]
    failures, rows = int(of_sample.sum()), len(predictions.rows)
    caution = ""
    if min(failures, rows - failures) < FEWEST_OF_EACH_KIND:
        caution = (
            f"the twin fails in {failures} of {rows} {predictions.level}s: a conclusion needs {FEWEST_OF_EACH_KIND} "
            f"that fail and {FEWEST_OF_EACH_KIND} that do not"
        )
    baseline = scores.brier(predictions.probabilities[UNDRIVEN], truth, weights)
    least = 1.0 / (rows + 2)
    found = []
    for name, probability in predictions.probabilities.items():
        squared = scores.brier(probability, truth, weights)
        precision = scores.average_precision(probability, failing, weights)
        r = scores.pearson(probability, truth, weights)
        sample = probability if probability.ndim == 1 else probability[:1]
        own_truth, own_failing = (v if v.ndim == 1 else v[:1] for v in (truth, failing))
        bounded = np.clip(sample, least, 1.0 - least)
        other = None if name == UNDRIVEN else squared - baseline
        found.append(
            PredictorScore(
                level=predictions.level,
                predictor=name,
                rows=rows,
                families=families,
                brier=float(squared[0]),
                brier_interval=scores.interval_of(squared),
                difference=None if other is None else float(other[0]),
                difference_interval=None if other is None else scores.interval_of(other),
                log_loss=float(scores.log_loss(bounded, own_truth, weights[:1])[0]),
                recall=tuple(_value(scores.recall(sample, own_failing, weights[:1], t)) for t in THRESHOLDS),
                false_alarms=tuple(
                    _value(scores.false_alarms(sample, own_failing, weights[:1], t)) for t in THRESHOLDS
                ),
                average_precision=_value(precision),
                average_precision_interval=scores.interval_of(precision),
                r=_value(r),
                r_interval=scores.interval_of(r) if _value(r) is not None else None,
                caution=caution,
            )
        )
    return found


def _value(resampled: Array) -> float | None:
    """Score of the sample itself; None where it is not defined."""
    return None if np.isnan(resampled[0]) else float(resampled[0])


def _reliability(predictions: Predictions, name: str) -> list[ReliabilityBin]:
    probability = predictions.probabilities[name]
    bins = np.clip(np.digitize(probability, BINS[1:-1]), 0, len(BINS) - 2)
    found = []
    for k in np.unique(bins):
        chosen = bins == k
        failed, tests = int(predictions.truth[chosen].sum()), int(chosen.sum())
        found.append(
            ReliabilityBin(
                predictor=name, low=BINS[k], high=BINS[k + 1], tests=tests, predicted=float(probability[chosen].mean()),
                observed=failed / tests, interval=jeffreys_interval(failed, tests),
            )
        )  # fmt: skip
    return found


def comparison_tables(found: PredictorComparison) -> list[Table]:
    """Tabulate a comparison: errors and decisions per test, the same per cell, reliability."""
    tables = []
    for level in dict.fromkeys(one.level for one in found.scores):
        rows = [one for one in found.scores if one.level == level]
        tables += [_error_table(found.twin, rows, level), _decision_table(found.twin, rows, level)]
    return [*tables, _reliability_table(found)]


def _error_table(twin: str, rows: Sequence[PredictorScore], level: str) -> Table:
    first = rows[0]
    return Table(
        name=f"predictors_per_{level}",
        title=f"Failures on {twin} predicted without driving it: {first.rows} {level}s of {first.families} families",
        columns=[
            Column("predictor"), Column("Brier", "number"), Column("95 %", "number"), Column("bits", "number"),
            Column("Brier minus undriven", "number"), Column("95 % of it", "number"), Column("verdict"),
        ],
        rows=[
            (
                one.predictor, one.brier, one.brier_interval, one.log_loss, one.difference, one.difference_interval,
                one.verdict,
            )
            for one in rows
        ],
        notes=[
            "A predictor adds to the undriven features if the 95 % interval of the difference lies below 0; intervals "
            "resample whole families of tests.",
            *([first.caution] if first.caution else []),
        ],
    )  # fmt: skip


def _decision_table(twin: str, rows: Sequence[PredictorScore], level: str) -> Table:
    return Table(
        name=f"predictor_decisions_per_{level}",
        title=f"{level.capitalize()}s called failing on {twin}",
        columns=[
            Column("predictor"),
            *(
                Column(f"{what} at {threshold:g}", "number")
                for threshold in THRESHOLDS
                for what in ("recall", "false alarms")
            ),
            Column("AUC-PRC", "number"), Column("95 %", "number"), Column("r", "number"),
            Column("95 % of r", "number"), Column("worth, drives", "number"),
        ],
        rows=[
            (
                one.predictor, *(v for pair in zip(one.recall, one.false_alarms, strict=True) for v in pair),
                one.average_precision, one.average_precision_interval, one.r, one.r_interval, one.worth,
            )
            for one in rows
        ],
        notes=[
            "worth: drives on the twin that one drive is worth with this prediction as a control variate, 1 / (1 - r^2)"
        ],
    )  # fmt: skip


def _reliability_table(found: PredictorComparison) -> Table:
    return Table(
        name="predictor_reliability",
        title=f"Reliability: predicted and observed failures on {found.twin}",
        columns=[
            Column("predictor"), Column("from", "number"), Column("to", "number"), Column("tests", "count"),
            Column("predicted", "number"), Column("observed", "number"), Column("95 %", "number"),
        ],
        rows=[
            (one.predictor, one.low, one.high, one.tests, one.predicted, one.observed, one.interval)
            for one in found.reliability
        ],
    )  # fmt: skip
