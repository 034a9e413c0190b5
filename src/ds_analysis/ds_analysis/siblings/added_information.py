# SPDX-License-Identifier: Apache-2.0
"""How well road features and conditions predict failures, and what each sibling adds to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ds_analysis.common.cross_validation import (
    FOLDS,
    REPEATS,
    Columns,
    auc_roc_by_ranks,
    bits,
    predict_failures,
    predict_with,
)
from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import FEWEST_OF_EACH_KIND, Array, Bools, Interval, interval_over_families
from ds_base.words import listed
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
