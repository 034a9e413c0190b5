"""What is predicted of a car, from every simulator that was driven and from the car's own drives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.prediction.real.records import read_drives
from ds_analysis.prediction.real.update import margin_drives
from ds_analysis.prediction.twin_prediction import TwinPrediction, predict_twin
from ds_analysis.prediction.verdicts import TOLERATED_RATE, Verdicts, judge


@dataclass(frozen=True, kw_only=True)
class CarPrediction:
    """What is predicted of a car.

    Attributes:
        table: outcomes; a driven twin is one more sibling.
        prediction: of the table's tests.
        verdicts: of every test and cell.
        drives: number of drives of the car.
        failed: number of them that failed.
    """

    table: OutcomeTable
    prediction: TwinPrediction
    verdicts: Verdicts
    drives: int
    failed: int

    @property
    def sentence(self) -> str:
        """The answer in one line."""
        names, counts = self.table.siblings, self.verdicts.counts
        tested = sum(counts.values()) - counts["untested"]
        share = float(np.mean([one.probability for one in self.verdicts.tests]))
        known = f"after {self.drives} real drive{'' if self.drives == 1 else 's'}, {self.failed} failed"
        named = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
        fail, safe, disputed = (counts[name] for name in ("fails", "safe", "disputed"))
        return (
            f"{self._uniform}On a car, predicted from {named} {known if self.drives else 'without a real drive'}: "
            f"{fail} of {tested} cell{'' if tested == 1 else 's'} fail{'s' if fail == 1 else ''}, "
            f"{safe} {'is' if safe == 1 else 'are'} safe, {disputed} {'is' if disputed == 1 else 'are'} disputed; "
            f"{100 * share:.0f} % of these tests are expected to fail."
        )

    @property
    def _uniform(self) -> str:
        """What all simulators did, where they did the same in every test; "" otherwise."""
        known = np.stack([self.table.known(name) for name in self.table.siblings])
        failed = np.stack([self.table.failed(name) for name in self.table.siblings])[known]
        if not len(failed) or failed.any() != failed.all():
            return ""
        return f"{'Every' if failed.all() else 'None of the'} {len(failed)} simulated drives failed. "


def predict_car(folder: Path, table: OutcomeTable, *, tolerated: float = TOLERATED_RATE) -> CarPrediction:
    """Predict a car from a campaign's outcomes, its twin's among them, and from the car's own drives.

    Args:
        folder: campaign folder, which may hold drives of the car.
        table: outcomes of the campaign.
        tolerated: failure rate up to which a cell counts as safe.

    Raises:
        ds_analysis.common.outcome_table.OutcomeTableError: there are too few tests.
        ds_analysis.prediction.real.records.RecordError: the drives of the car cannot be read or are of other tests.
    """
    drives = read_drives(folder)
    known = table.as_population()
    prediction = predict_twin(known)
    prediction = prediction.updated(margin_drives(known, drives))
    return CarPrediction(
        table=known,
        prediction=prediction,
        verdicts=judge(known, prediction, tolerated=tolerated),
        drives=len(drives),
        failed=sum(drive.failed for drive in drives),
    )
