# SPDX-License-Identifier: Apache-2.0
"""Bets on a car's drives: whether its siblings have helped to predict them, and how many tests fail on the car.

A gambler without knowledge ever has 1 / `ALPHA` times his capital with a probability of at most `ALPHA`, however one
stops (Ville's inequality; Waudby-Smith and Ramdas, J. R. Stat. Soc. B 2024). `benchmarks/predictors.py` measures it.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from ds_analysis.common.statistics import Array, Bools
from ds_analysis.prediction.mixture import Drive, Prediction
from ds_base.words import count

ALPHA = 0.05
"""Probability with which a statement may be wrong."""
_LEAST = 0.005
"""Least probability of either verdict; chosen: one drive changes capital by a factor of 200 at most."""
_MOST = 500.0
"""Logarithm of the largest capital that is kept, which is still a finite number."""
_EACH = 50
"""Drives up to which each is predicted from all before it; beyond, predictions are renewed every fiftieth part."""


def predicted_before(undriven: Prediction, prediction: Prediction) -> Iterator[tuple[Drive, Prediction]]:
    """Yield every drive of a prediction with what was predicted, by the same experts, from the drives before it."""
    used = 0
    for k, drive in enumerate(prediction.drives):
        if k - used >= max(1, k // _EACH):
            undriven, used = undriven.updated(prediction.drives[used:k]), k
        yield drive, undriven


@dataclass(frozen=True, kw_only=True)
class SiblingHelp:
    """Whether the siblings have helped to predict the car's drives."""

    drives: int = 0
    with_siblings: float = 0.0  # mean squared error of predictions with the siblings; `without`: without them
    without: float = 0.0
    helped: float = 1.0  # largest capital, so far, of the bet that the siblings help, now `capital`
    misled: float = 1.0  # the same of the bet that predictions without them are better
    capital: float = 1.0

    @property
    def answer(self) -> str:
        """`helped`, `misled` or `open`; where both bets were won at times, the one that leads now."""
        shown = {"helped": self.helped * ALPHA >= 1.0, "misled": self.misled * ALPHA >= 1.0}
        leading = "helped" if self.capital > 1.0 else "misled"
        return leading if shown[leading] else next((name for name, holds in shown.items() if holds), "open")

    @property
    def sentence(self) -> str:
        """The answer in one line; "" without drives."""
        if not self.drives:
            return ""
        said = {
            "helped": "your simulators have helped to tell which tests the car fails",
            "misled": "your simulators have not helped: which tests the car fails is predicted better without them",
            "open": "it is open whether your simulators tell which tests the car fails",
        }[self.answer]
        sure = "" if self.answer == "open" else f"; this is wrong in at most {ALPHA:.0%} of cases"
        return (
            f"After {count(self.drives, 'drive')} {said} (mean squared error {self.with_siblings:.2f} with them, "
            f"{self.without:.2f} without{sure})."
        )


def sibling_help(undriven: Prediction, prediction: Prediction) -> SiblingHelp:
    """Bet on every drive of a prediction, in their order; `undriven` is by the same experts without drives.

    The experts that use the siblings' outcomes bet against those that see features and drives alone.
    """
    sides = [(undriven.only(siblings=one), prediction.only(siblings=one)) for one in (True, False)]
    left = np.ones(undriven.tests, np.bool_)
    log_capital, errors = [0.0], []
    for (drive, using), (_, alone) in zip(*(predicted_before(*side) for side in sides), strict=True):
        first, second = (np.clip(one.probabilities(), _LEAST, 1.0 - _LEAST) for one in (using, alone))
        log_capital.append(log_capital[-1] + _log_share(first, drive, left) - _log_share(second, drive, left))
        errors.append([(one[drive.row] - drive.failed) ** 2 for one in (first, second)])
        left[drive.row] = False
    if not errors:
        return SiblingHelp()
    with_siblings, without = np.mean(errors, axis=0)
    return SiblingHelp(
        drives=len(errors),
        with_siblings=float(with_siblings),
        without=float(without),
        helped=_capital(max(log_capital)),
        misled=_capital(-min(log_capital)),
        capital=_capital(log_capital[-1]),
    )


def _capital(logarithm: float) -> float:
    return float(np.exp(np.clip(logarithm, -_MOST, _MOST)))


def _log_share(failing: Array, drive: Drive, left: Bools) -> float:
    """Log probability that a drawn test is this one, given its verdict; of a chosen test, of its verdict."""
    likelihood = failing if drive.failed else 1.0 - failing
    return float(np.log(likelihood[drive.row]) - (np.log(likelihood[left].mean()) if drive.drawn else 0.0))


_STAKES = np.array([0.2, 0.5, 0.95])
"""Stakes of equal weights, each on either side; chosen: any value below 1 is valid, and some fit any rate."""


@dataclass(frozen=True, kw_only=True)
class Bet:
    """One drive, whose test was drawn uniformly from those left, or chosen, and its probability of failure before."""

    failed: bool
    drawn: bool
    predicted: float = 0.0
    mean_predicted: float = 0.0  # over the tests left, its own among them


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """Smallest and largest number of tests that fail on a car, not refuted yet by so many drawn drives."""

    tests: int
    drawn: int
    low: int
    high: int

    @property
    def sentence(self) -> str:
        """What is certain, in one line."""
        shares = f"{100 * self.low / self.tests:.0f} to {100 * self.high / self.tests:.0f}%"
        return (
            f"Certain with 95%, whenever you stop: the car fails on {self.low} to {self.high} of {self.tests} tests "
            f"({shares}), by {count(self.drawn, 'drive')} drawn at random."
        )


def certify(bets: Sequence[Bet], tests: int) -> Certificate:
    """Bound the number of failing tests among all that can be driven, from all drives so far, in their order.

    Against each number two gamblers bet at each drawn drive, one on the verdict, one on its difference from the
    probability that was predicted (arXiv 2606.24038); their capitals are averaged. Chosen drives are no bets.

    Examples:
        >>> found = certify([Bet(failed=False, drawn=True)] * 60, tests=200)
        >>> found.low, found.high < 20
        (0, True)
    """
    total = np.arange(tests + 1.0)
    stakes = np.concatenate((-_STAKES, _STAKES))
    log_capital = np.zeros((2, len(stakes), tests + 1))
    kept = np.ones(tests + 1, np.bool_)
    failures, left = 0, tests
    for bet in bets:
        if bet.drawn:
            mean = np.clip((total - failures) / left, 0.0, 1.0)
            plain = float(bet.failed) - mean
            helped = plain - (bet.predicted - bet.mean_predicted)
            log_capital[0] += np.log1p(stakes[:, None] * plain)
            log_capital[1] += np.log1p(0.5 * stakes[:, None] * helped)  # which lies between -2 and 2
            kept &= logsumexp(log_capital, axis=(0, 1)) < np.log(2 * len(stakes) / ALPHA)
        failures, left = failures + bet.failed, left - 1
        kept &= (total >= failures) & (total <= failures + left)
    possible = np.flatnonzero(kept)
    drawn = sum(bet.drawn for bet in bets)
    if not len(possible):  # refuted altogether, which is as rare as a wrong bound
        return Certificate(tests=tests, drawn=drawn, low=failures, high=failures + left)
    return Certificate(tests=tests, drawn=drawn, low=int(possible[0]), high=int(possible[-1]))


def drives_until(rate: float, tests: int) -> int | None:
    """Count the drawn drives without a failure after which at most a share of the tests can fail; None if never."""

    def enough(drives: int) -> bool:
        return certify([Bet(failed=False, drawn=True)] * drives, tests).high <= rate * tests

    return 1 + bisect_left(range(1, tests + 1), True, key=enough) if enough(tests) else None
