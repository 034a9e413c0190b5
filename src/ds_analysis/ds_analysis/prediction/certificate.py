# SPDX-License-Identifier: Apache-2.0
"""Bounds on how many tests fail on a car that hold however one stops: a confidence sequence by betting."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from ds_base.words import count

ALPHA = 0.05
"""Probability with which a statement may be wrong. A gambler without knowledge ever has 1 / `ALPHA` times his capital
with a probability of at most `ALPHA`, however one stops (Ville's inequality; Waudby-Smith and Ramdas, J. R. Stat. Soc.
B 2024). `benchmarks/predictors.py` measures it."""
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
