"""Selects the tests whose outcomes on a car would tell most, and says what such drives are worth and when to stop.

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

from ds_analysis.common.outcome_table import OutcomeTable, State
from ds_analysis.common.statistics import Array, Indices
from ds_analysis.prediction.twin_prediction import TwinPrediction, of_any_kind

DRAWS = 500
"""Draws behind the covariances of tests; chosen: a choice among thousands of tests takes a second."""


class BudgetError(ValueError):
    """A number of drives that cannot be proposed."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A test to drive.

    Attributes:
        row: row of the test.
        gain: expected reduction of the mean squared error of all predicted probabilities, each cell counting the same,
            by this drive after those chosen before it; None for a test that was drawn at random.
    """

    row: int
    gain: float | None


def candidates_of(table: OutcomeTable, prediction: TwinPrediction) -> Indices:
    """Rows of the tests that a car can be asked to drive: judged by a sibling, excluded on none, not driven yet."""
    columns = [table.column(name) for name in table.siblings]
    states = table.states[:, columns]
    usable = np.isin(states, (State.COMPLETED, State.FAILED)).any(axis=1) & ~(states == State.EXCLUDED).any(axis=1)
    usable[[drive.row for drive in prediction.drives]] = False
    return np.flatnonzero(usable)


def choose(table: OutcomeTable, prediction: TwinPrediction, drives: int, *, drawn: bool = True) -> list[Choice]:
    """Choose every other test, each with the largest expected gain given those before, and draw the others at random.

    What is chosen tells most if the car is like its siblings (`ds_analysis.prediction.population.KINDS`), and misleads
    if it is not, which drawn tests show. They are drawn uniformly from all that are left, as a certificate wants it
    (`ds_analysis.prediction.real.certificate`), whatever came out before.

    The gain of a verdict on test c about test j is cov(p_j, p_c)^2 / var(y_c) (the variance of p_j that a linear
    regression on the verdict y_c explains), over what is uncertain about the car. A chosen test takes its part out of
    all covariances, so that the next one tells something else; the sum over tests is submodular, and the greedy choice
    is near the best (Krause, Singh, Guestrin, JMLR 2008). Each family of mutants gives one test as long as others are
    left.

    Args:
        table: outcomes of the siblings.
        prediction: of the table's tests.
        drives: number of tests to choose.
        drawn: whether every other one is drawn at random.

    Raises:
        BudgetError: there are fewer candidates.
    """
    candidates = candidates_of(table, prediction)
    if drives > len(candidates):
        raise BudgetError(
            f"{drives} drives: {len(candidates)} tests can be proposed, expected a budget of at most {len(candidates)}"
        )
    draws = replace(prediction, coefficients=prediction.coefficients.alike).draws(DRAWS)
    mean = draws.mean(axis=0)
    noise = np.maximum(mean - (draws**2).mean(axis=0), 0.0)  # mean of p (1 - p): what a known car leaves to chance
    factor = (draws - mean) / np.sqrt(DRAWS)
    weights = _cell_weights(table)
    chosen: list[Choice] = []
    left = np.zeros(len(table), np.bool_)
    left[candidates] = True
    while len(chosen) < drives:
        fresh = left & ~np.isin(table.families, [table.families[one.row] for one in chosen])
        allowed = fresh if fresh.any() else left
        variance = (factor**2).sum(axis=0)
        total = variance + noise
        gram = (factor * weights) @ factor.T
        gain = np.where(total > _NOTHING, (factor * (gram @ factor)).sum(axis=0) / np.maximum(total, _NOTHING), 0.0)
        place = len(prediction.drives) + len(chosen)
        if drawn and place % 2:
            row = int(np.random.default_rng([_SEED, place]).choice(np.flatnonzero(left)))
            chosen.append(Choice(row=row, gain=None))
        else:
            row = int(np.argmax(np.where(allowed, gain, -1.0)))
            chosen.append(Choice(row=row, gain=float(gain[row])))
        left[row] = False
        if variance[row] > _NOTHING:
            direction = factor[:, row] / np.sqrt(variance[row])
            kept = np.sqrt(noise[row] / total[row])
            factor = factor - (1.0 - kept) * np.outer(direction, direction @ factor)
    return chosen


def expected_error(table: OutcomeTable, prediction: TwinPrediction) -> float:
    """Expected mean squared error of all predictions, each cell counting the same, if the car is like its siblings."""
    probabilities = replace(prediction, coefficients=prediction.coefficients.alike).probabilities()
    return float(_cell_weights(table) @ (probabilities * (1.0 - probabilities)))


_SEED = 23
"""Seed of the tests that are drawn; any number does."""
_NOTHING = 1e-12
"""Variance below which a test tells nothing."""


def _cell_weights(table: OutcomeTable) -> Array:
    """Weights of tests, which sum to 1: every cell counts the same, and so does every test of a cell."""
    cells = {cell: k for k, cell in enumerate(dict.fromkeys(table.cells))}
    member = np.array([cells[cell] for cell in table.cells])
    weights = 1.0 / np.bincount(member)[member]
    return np.asarray(weights / weights.sum())


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

    known = replace(before.population, twin=before.population.limit)
    limit = replace(before, coefficients=of_any_kind(known, before.coefficients.shares))
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
        (choice,) = choose(table, prediction, 1, drawn=False)
    except BudgetError:
        return None
    error = expected_error(table, prediction)
    return (choice.gain or 0.0) / error if error > 0.0 else 0.0


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
