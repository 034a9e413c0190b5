# SPDX-License-Identifier: Apache-2.0
"""Whether the siblings have helped to predict the car: a bet on every drive, with them against without them.

Each drive is predicted from those before it, by the experts that use the siblings' outcomes and by those that see
features and drives alone. Of a drawn drive, either side says how probable it was that this test, of all that were left,
has the verdict that came out, so that the failure rate cancels; of a chosen test, how probable its verdict was. The
capital of the bet is the product of the ratios.

If the side without siblings is right, capital ever reaches 1 / `ALPHA` with a probability of at most `ALPHA` (Ville's
inequality; Waudby-Smith and Ramdas, J. R. Stat. Soc. B 2024). `benchmarks/predictors.py` measures it where neither is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

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
    """Bet on every drive of a prediction, in their order; `undriven` is by the same experts without drives."""
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
