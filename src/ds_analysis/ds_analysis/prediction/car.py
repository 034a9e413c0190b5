# SPDX-License-Identifier: Apache-2.0
"""What is predicted of a car, from every simulator that was driven and from its own drives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import Array, Bools
from ds_analysis.prediction.certificate import ALPHA, Bet, Certificate, certify
from ds_analysis.prediction.mixture import Drive, Prediction, predict
from ds_analysis.prediction.verdicts import TOLERATED_RATE, Verdicts, judge
from ds_analysis.real.proposal import Proposed, candidates_of, read_proposed
from ds_analysis.real.records import RealDrive, RecordError, read_drives
from ds_base.words import count, listed

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


@dataclass(frozen=True, kw_only=True, eq=False)
class CarPrediction:
    """What is predicted of a car.

    Attributes:
        table: outcomes; a driven twin is one more sibling.
        prediction: with the car's drives, in the order in which their tests were drawn; `undriven` is without.
        tolerated: failure rate up to which a cell counts as safe.
    """

    table: OutcomeTable
    undriven: Prediction
    prediction: Prediction
    drives: Sequence[RealDrive]
    proposed: Proposed
    tolerated: float = TOLERATED_RATE

    @cached_property
    def before(self) -> Verdicts:
        """Verdicts without the drives."""
        return judge(self.table, self.undriven, tolerated=self.tolerated)

    @cached_property
    def verdicts(self) -> Verdicts:
        """Verdicts of every test and cell."""
        return judge(self.table, self.prediction, tolerated=self.tolerated) if self.drives else self.before

    @cached_property
    def help(self) -> SiblingHelp:
        """Whether the siblings have helped to predict the drives."""
        return sibling_help(self.undriven, self.prediction)

    @property
    def open(self) -> Sequence[str]:
        """Proposed tests that were not recorded."""
        driven = {drive.test_id for drive in self.drives}
        return [test_id for test_id in self.proposed.tests if test_id not in driven]

    @cached_property
    def certificate(self) -> Certificate | None:
        """Bounds on the tests that fail, from drawn drives up to the first that was not recorded; None without any."""
        population = self.proposed.population or [self.table.test_ids[row] for row in candidates_of(self.table)]
        left = np.isin(self.table.test_ids, population)
        bets = []
        for drive, predicted in predicted_before(self.undriven, self.prediction):
            if left[drive.row]:
                probabilities = predicted.probabilities()
                mean = float(probabilities[left].mean())
                row = float(probabilities[drive.row])
                bets.append(Bet(failed=drive.failed, drawn=drive.drawn, predicted=row, mean_predicted=mean))
                left[drive.row] = False
        return certify(bets, len(population)) if any(bet.drawn for bet in bets) else None

    @property
    def sentence(self) -> str:
        """The answer in one line."""
        counts, tests = self.verdicts.counts, self.verdicts.undriven
        named, cells = listed(self.table.siblings), sum(counts.values()) - counts["untested"]
        rows = np.array([self.table.rows[one.test_id] for one in tests], np.intp)
        expected, low, high = self.prediction.failures(rows)
        many = f"{expected:.0f} (90%: {low} to {high})"
        fails, safe, disputed = (counts[name] for name in ("fails", "safe", "disputed"))
        of_cells = (
            f"of {count(cells, 'cell')} {fails} fail{'s' if fails == 1 else ''}, {safe} "
            f"{'is' if safe == 1 else 'are'} safe and {disputed} {'is' if disputed == 1 else 'are'} disputed"
        )
        if not self.drives:
            return (
                f"{self._uniform}On a car, predicted from {named} without a real drive, {many} of {len(tests)} "
                f"tests are expected to fail; {of_cells}."
            )
        failed = sum(drive.failed for drive in self.drives)
        return (
            f"Of the {len(tests)} tests that the car has not driven, {many} are expected to fail; {of_cells}. The car "
            f"drove {count(len(self.drives), 'test')} and failed {failed}; the rest is predicted from these drives and "
            f"{named}."
        )

    @property
    def _uniform(self) -> str:
        """What all simulators did, where they did the same in every test; "" otherwise."""
        driven, failed = self.table.sibling_verdicts
        failed = failed[driven]
        if not len(failed) or failed.any() != failed.all():
            return ""
        return f"{'Every' if failed.all() else 'None of the'} {len(failed)} simulated drives failed. "

    @property
    def changed(self) -> list[dict[str, Any]]:
        """Cells whose verdict the drives changed."""
        return [
            {"cell": one.cell, "before": one.verdict, "after": two.verdict}
            for one, two in zip(self.before.cells, self.verdicts.cells, strict=True)
            if one.verdict != two.verdict
        ]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        expected = [float(np.mean([one.probability for one in of.tests])) for of in (self.before, self.verdicts)]
        return {
            "sentence": self.sentence,
            "siblings": list(self.table.siblings),
            "drives": [asdict(drive) for drive in self.drives],
            "open": list(self.open),
            "failures": expected,
            "experts": dict(self.prediction.shares),
            "help": {**asdict(self.help), "answer": self.help.answer, "sentence": self.help.sentence},
            "certificate": None if self.certificate is None else asdict(self.certificate),
            "verdicts": self.verdicts.document(),
            "before": self.before.document(),
            "changed": self.changed,
        }


def predict_car(folder: Path, table: OutcomeTable, *, tolerated: float = TOLERATED_RATE) -> CarPrediction:
    """Predict a car from a campaign's outcomes, its twin's among them, and from the car's own drives in the folder.

    Raises:
        ds_analysis.common.outcome_table.OutcomeTableError: there are too few tests.
        ds_analysis.real.records.RecordError: the drives of the car cannot be read or are of other tests.
    """
    population, drives, proposed = table.as_population(), read_drives(folder), read_proposed(folder)
    undriven = predict(population)
    ordered = drives_in_order(population, drives, proposed)
    return CarPrediction(
        table=population,
        undriven=undriven,
        prediction=undriven.updated(ordered),
        drives=drives,
        proposed=proposed,
        tolerated=tolerated,
    )


def drives_in_order(table: OutcomeTable, drives: Sequence[RealDrive], proposed: Proposed) -> list[Drive]:
    """Order drives as their tests were drawn; from the first that was not recorded on, none counts as drawn.

    A driver who leaves out the tests that look hard would otherwise certify the easy ones. `RecordError` if a drive is
    of no test of the table.
    """
    rows = table.rows
    left = {drive.test_id: drive for drive in drives}
    for test_id in left:
        if test_id not in rows:
            raise RecordError(f"the real drive of {test_id!r:.60} is of no test here: remove it from the drives")
    ordered, complete = [], True
    for test_id, drawn in proposed.in_order():
        complete &= not drawn or test_id in left
        if test_id in left:
            one = left.pop(test_id)
            ordered.append(Drive(rows[test_id], one.failed, complete and (drawn or one.drawn)))
    return [*ordered, *(Drive(rows[one.test_id], one.failed, complete and one.drawn) for one in left.values())]
