"""What real drives change: predictions before and after them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from typing import Any

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.prediction.margins import margin
from ds_analysis.prediction.real.certificate import Bet, Certificate, certify
from ds_analysis.prediction.real.drive_choice import Worth, candidates_of, worth_of
from ds_analysis.prediction.real.records import RealDrive, RecordError
from ds_analysis.prediction.twin_prediction import MarginDrive, Span, TwinPrediction, span_of
from ds_analysis.prediction.verdicts import CellVerdict, Verdicts, judge


@dataclass(frozen=True, kw_only=True)
class ChangedCell:
    """A cell whose verdict the drives changed."""

    cell: tuple[int, ...]
    before: str
    after: str


@dataclass(frozen=True, kw_only=True)
class Update:
    """What real drives change.

    Attributes:
        drives: the drives.
        before: verdicts without them.
        after: verdicts with them.
        span: whether the car is outside of what the siblings span.
        failures_before: predicted share of tests that fail on the car, without the drives.
        failures_after: the same with them.
        width_before: mean width of the 90 % intervals of the cells' failure rates, without the drives.
        width_after: the same with them.
        worth: what the drives are worth in other drives, and whether to go on.
        certificate: bounds on the tests that fail, from drawn drives; None without any.
    """

    drives: Sequence[RealDrive]
    before: Verdicts
    after: Verdicts
    span: Span
    failures_before: float
    failures_after: float
    width_before: float
    width_after: float
    worth: Worth
    certificate: Certificate | None

    @property
    def changed(self) -> list[ChangedCell]:
        """Cells whose verdict changed."""
        return [
            ChangedCell(cell=one.cell, before=one.verdict, after=two.verdict)
            for one, two in zip(self.before.cells, self.after.cells, strict=True)
            if one.verdict != two.verdict
        ]

    @property
    def sentence(self) -> str:
        """What changed, in one line."""
        failed = sum(drive.failed for drive in self.drives)
        return (
            f"{len(self.drives)} real drives, {failed} failed: expected failures {self.failures_before:.0%} before, "
            f"{self.failures_after:.0%} after; intervals of cells {self.width_before:.2f} wide before, "
            f"{self.width_after:.2f} after; {len(self.changed)} cells changed their verdict"
        )

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "drives": [asdict(drive) for drive in self.drives],
            "before": self.before.document(),
            "after": self.after.document(),
            "changed": [asdict(one) for one in self.changed],
            "span": self.span.document(),
            "failures": [self.failures_before, self.failures_after],
            "interval_width": [self.width_before, self.width_after],
            "worth": self.worth.document(),
            "certificate": None if self.certificate is None else asdict(self.certificate),
            "sentence": self.sentence,
        }


def margin_drives(table: OutcomeTable, drives: Sequence[RealDrive]) -> list[MarginDrive]:
    """Convert real drives to margins.

    Raises:
        RecordError: a test is not among the table's.
    """
    rows = {test_id: row for row, test_id in enumerate(table.test_ids)}
    found = []
    for drive in drives:
        if drive.test_id not in rows:
            raise RecordError(f"the real drive of {drive.test_id!r:.60} is of no test here: remove it from the drives")
        row = rows[drive.test_id]
        lateral = drive.max_lateral_position
        known = None if lateral is None or drive.failed else np.array([lateral])
        found.append(
            MarginDrive(
                row=row,
                failed=drive.failed,
                margin=None if known is None else float(margin(known, table.limits[row : row + 1, 0])[0]),
            )
        )
    return found


def update(
    table: OutcomeTable,
    prediction: TwinPrediction,
    drives: Sequence[RealDrive],
    *,
    tolerated: float,
    rounds: Sequence[Sequence[Mapping[str, Any]]] = (),
) -> Update:
    """Compare predictions before and after real drives.

    Args:
        table: outcomes of the siblings.
        prediction: without the drives.
        drives: the real drives.
        tolerated: failure rate up to which a cell counts as safe.
        rounds: proposals, in the order of their drives; see `ds_analysis.prediction.real.proposal`.

    Raises:
        RecordError: a drive is of no test of the table.
    """
    known = prediction.updated(margin_drives(table, drives))
    before, after = (judge(table, one, tolerated=tolerated) for one in (prediction, known))
    return Update(
        drives=tuple(drives),
        before=before,
        after=after,
        span=span_of(known),
        failures_before=_expected(before),
        failures_after=_expected(after),
        width_before=_width(before.cells),
        width_after=_width(after.cells),
        worth=worth_of(table, prediction, known),
        certificate=_certificate(table, prediction, drives, rounds),
    )


def _certificate(
    table: OutcomeTable,
    prediction: TwinPrediction,
    drives: Sequence[RealDrive],
    rounds: Sequence[Sequence[Mapping[str, Any]]],
) -> Certificate | None:
    """Bound the failures by the drives in the order in which they were proposed, up to the first without outcome."""
    outcomes = {drive.test_id: drive for drive in drives}
    left = np.zeros(len(table), np.bool_)
    left[candidates_of(table, prediction)] = True
    tests, bets = int(left.sum()), []
    for row in chain.from_iterable(rounds):
        if row["test_id"] not in outcomes:
            break
        (drive,) = margin_drives(table, [outcomes[row["test_id"]]])
        probabilities = prediction.probabilities()
        bets.append(
            Bet(
                failed=drive.failed,
                drawn=row.get("gain", 0.0) is None,
                predicted=float(probabilities[drive.row]),
                mean_predicted=float(probabilities[left].mean()),
            )
        )
        left[drive.row] = False
        prediction = prediction.updated([drive])
    return certify(bets, tests) if any(bet.drawn for bet in bets) else None


def _expected(verdicts: Verdicts) -> float:
    return float(np.mean([one.probability for one in verdicts.tests]))


def _width(cells: Sequence[CellVerdict]) -> float:
    widths = [one.interval[1] - one.interval[0] for one in cells if one.interval is not None]
    return float(np.mean(widths)) if widths else 0.0
