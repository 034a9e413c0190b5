"""What real drives are worth in other drives, at equal width of the same interval, and when to stop.

The quantity is the car's failure rate over a campaign's tests; the width is that of its 90 % interval. Anchors are
control variates (Sim2Val) and prediction-powered inference (Angelopoulos et al., Science 2023; SureSim: Badithela et
al., 2025): predictions that correlate with outcomes by r make one random real drive worth at most 1 / (1 - r^2) without
them, however many tests are simulated.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import beta

from ds_analysis.prediction.outcome_table import OutcomeTable
from ds_analysis.prediction.real.selection import BudgetError, choose, expected_error
from ds_analysis.prediction.twin_prediction import TwinPrediction

LEAST_GAIN = 0.05
"""Share of the expected squared error that the next drive should take away; chosen: below a twentieth, its effect on
any score is smaller than what these tests can show."""
_LOW, _HIGH = 0.05, 0.95
"""Ends of the interval."""
_MOST = 1e9
"""Random drives beyond which a width is not reached."""


@dataclass(frozen=True, kw_only=True)
class Worth:
    """What some real drives are worth.

    Attributes:
        drives: number of real drives.
        width_before: width of the 90 % interval of the car's failure rate, without them.
        width_limit: the same if the siblings had driven any number of tests like these.
        width_after: the same with the real drives.
        simulated: drives on the siblings, beyond those there are, that would narrow the interval as much as one of the
            real drives did; infinite if none would; None if the real drives did not narrow it.
        random_alone: random drives on the car that give as narrow an interval without simulators (Jeffreys' posterior
            at the same mean rate).
        control_variate: random drives without predictions that one with them is worth, 1 / (1 - r^2), with the r that
            the predictions before the drives expect of themselves.
        next_gain: share of the expected squared error that the best next drive is expected to take away; None if no
            test is left.
    """

    drives: int
    width_before: float
    width_limit: float
    width_after: float
    simulated: float | None
    random_alone: float
    control_variate: float
    next_gain: float | None

    @property
    def stop(self) -> bool:
        """Whether another drive is not worth its while."""
        return self.next_gain is None or self.next_gain < LEAST_GAIN

    @property
    def sentences(self) -> list[str]:
        """What the numbers say, one line each."""
        each = f"the {self.drives} real drives" if self.drives > 1 else "the real drive"
        widths = (
            f"90 % interval of the car's failure rate: {self.width_before:.2f} wide before, {self.width_after:.2f} "
            f"after {each}, {self.width_limit:.2f} after any number of simulated drives on the same siblings"
        )
        if self.simulated is None:
            worth = f"{each} moved the prediction and did not narrow it: their worth in simulated drives is not defined"
        elif np.isinf(self.simulated):
            worth = f"no number of simulated drives on these siblings is worth {each}"
        else:
            worth = f"each real drive narrowed it as much as about {self.simulated:.0f} more simulated drives would"
        alone = (
            f"without simulators as narrow an interval takes about {self.random_alone:.0f} random real drives; with "
            f"the predictions as a control variate a random drive is worth {self.control_variate:.1f}"
        )
        if self.next_gain is None:
            further = "stop: every test was driven"
        else:
            further = (
                f"{'stop' if self.stop else 'go on'}: the best next drive is expected to take "
                f"{100 * self.next_gain:.1f} % of the squared error of the predictions, and a drive should take "
                f"{100 * LEAST_GAIN:.0f} %"
            )
        return [widths, worth, alone, further]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values; null also stands for an infinite number of simulated drives."""
        infinite = self.simulated is not None and np.isinf(self.simulated)
        return {
            **asdict(self), "simulated": None if infinite else self.simulated, "stop": self.stop,
            "sentences": self.sentences,
        }  # fmt: skip


def worth_of(table: OutcomeTable, before: TwinPrediction, after: TwinPrediction) -> Worth:
    """Compare the interval of the car's failure rate before and after its drives.

    With n tests on the siblings, the squared width is taken to be that of the limit and a rest that falls as 1 / n.

    Args:
        table: outcomes of the siblings.
        before: without the drives.
        after: with them, at least one.
    """
    rows = np.flatnonzero(np.any([table.known(name) for name in table.siblings], axis=0))

    def width(prediction: TwinPrediction) -> float:
        # As for the cells, a driven test tells about tests like it, and is not itself taken as known.
        low, high = np.quantile(prediction.draws(rows=rows, outcomes=False).mean(axis=1), (_LOW, _HIGH))
        return float(high - low)

    limit = replace(before, coefficients=before.population.limit)
    widths = width(before), min(width(limit), width(before)), width(after)
    probabilities = before.probabilities()[rows]
    mean = float(probabilities.mean())
    squared_r = float(probabilities.var()) / max(mean * (1.0 - mean), 1e-12)
    rate = float(after.draws(rows=rows, outcomes=False).mean())
    return Worth(
        drives=len(after.drives),
        width_before=widths[0],
        width_limit=widths[1],
        width_after=widths[2],
        simulated=_simulated(*widths, tests=len(rows), siblings=len(table.siblings), drives=len(after.drives)),
        random_alone=random_drives(widths[2], rate),
        control_variate=1.0 / max(1.0 - squared_r, 1e-6),
        next_gain=next_gain(table, after),
    )


def next_gain(table: OutcomeTable, prediction: TwinPrediction) -> float | None:
    """Share of the expected squared error that the best next drive is expected to take; None if no test is left."""
    try:
        (choice,) = choose(table, prediction, 1)
    except BudgetError:
        return None
    error = expected_error(table, prediction)
    return choice.gain / error if error > 0.0 else 0.0


def _simulated(before: float, limit: float, after: float, *, tests: int, siblings: int, drives: int) -> float | None:
    """Further drives on the siblings per real drive that bring the width from `before` to `after`."""
    if after >= before:
        return None
    if after <= limit:
        return float("inf")
    needed = tests * (before**2 - limit**2) / (after**2 - limit**2)
    return (needed - tests) * siblings / drives


def random_drives(width: float, rate: float) -> float:
    """Number of random drives whose failures, at a rate, leave a 90 % interval of some width; 0 if it takes none.

    Args:
        width: width of the interval.
        rate: share of the drives that fail.
    """

    def excess(log_drives: float) -> float:
        drives = np.exp(log_drives)
        low, high = beta.ppf((_LOW, _HIGH), rate * drives + 0.5, (1.0 - rate) * drives + 0.5)
        return float(high - low) - width

    if excess(np.log(1e-6)) <= 0.0:
        return 0.0
    if excess(np.log(_MOST)) >= 0.0:
        return _MOST
    return float(np.exp(brentq(excess, np.log(1e-6), np.log(_MOST))))
