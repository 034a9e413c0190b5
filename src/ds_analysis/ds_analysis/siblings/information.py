"""Information that a sibling adds about another simulator's failures, beyond features and other siblings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ds_analysis.common.cross_validation import REPEATS, Array, bits, predict_failures, predict_with
from ds_analysis.common.families import interval_over_families
from ds_analysis.siblings.baseline import Interval, caution_of_failures
from ds_analysis.siblings.outcomes import Outcomes


@dataclass(frozen=True, kw_only=True)
class AddedInformation:
    """What one sibling adds about the failures on another simulator.

    Attributes:
        about: simulator whose failures are predicted.
        sibling: sibling whose outcome and largest lateral position are added to the predictors.
        beyond: siblings whose outcomes are among the predictors already, besides road features and conditions.
        left: bits a road that these predictors leave: mean logarithmic loss on roads that the model has not seen.
        bits: reduction of that loss, bits a road; None where failures are too few.
        interval: 95 % interval of the reduction, by a bootstrap over families (paired: every road keeps both losses).
        caution: why there is no number, or "".
    """

    about: str
    sibling: str
    beyond: tuple[str, ...]
    left: float | None
    bits: float | None
    interval: Interval | None
    caution: str

    @property
    def verdict(self) -> str:
        """`adds information` if the interval lies above 0, `nothing shown`, or `too few`."""
        if self.bits is None:
            return "too few"
        return "adds information" if self.interval is not None and self.interval[0] > 0.0 else "nothing shown"

    @property
    def sentence(self) -> str:
        """What was found, in one line."""
        known = ["features", *self.beyond]
        beyond = known[0] if len(known) == 1 else f"{', '.join(known[:-1])} and {known[-1]}"
        if self.bits is None:
            return f"what {self.sibling} adds about {self.about} beyond {beyond}: {self.caution}"
        ends = f" ({self.interval[0]:z.3f} to {self.interval[1]:z.3f})" if self.interval else ""
        return f"{self.sibling} adds {self.bits:z.3f} bits{ends} about {self.about} beyond {beyond}: {self.verdict}"


def information_about(
    outcomes: Outcomes, about: str, siblings: Sequence[str], *, repeats: int = REPEATS
) -> list[AddedInformation]:
    """Compute what each sibling adds about one simulator's failures, one after the other.

    Args:
        outcomes: outcomes of the same driver on all simulators.
        about: simulator whose failures are predicted.
        siblings: the others, in the order in which they are added.
        repeats: divisions into folds over which losses are averaged.
    """
    failed = outcomes.failures(about)
    if caution := caution_of_failures(outcomes, about):
        return [
            AddedInformation(
                about=about, sibling=name, beyond=tuple(siblings[:k]), left=None, bits=None, interval=None,
                caution=caution,
            )
            for k, name in enumerate(siblings)
        ]  # fmt: skip
    predictions = predict_failures(outcomes.features, failed, families=outcomes.families, repeats=repeats)
    losses = bits(predictions.probability, failed)
    driven: list[Array] = []
    found = []
    for k, name in enumerate(siblings):
        # The largest lateral position is half a lane minus the fitness.
        driven += [outcomes.failures(name).astype(np.float64), outcomes.largest_lateral(name)]
        reduced = bits(predict_with(predictions, failed, np.column_stack(driven)), failed)
        gained = losses - reduced
        found.append(
            AddedInformation(
                about=about,
                sibling=name,
                beyond=tuple(siblings[:k]),
                left=float(losses.mean()),
                bits=float(gained.mean()),
                interval=interval_over_families((gained,), _mean, outcomes.families),
                caution="",
            )
        )
        losses = reduced
    return found


def _mean(values: Array) -> float:
    return float(values.mean())
