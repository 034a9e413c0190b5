"""First section of the report: where the car fails, is safe, disputed or untested, with its real drives marked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ds_orchestrator.campaign.campaign_data import CampaignData
from ds_orchestrator.campaign.refined_data import is_refined, with_refinement
from ds_orchestrator.prediction.outcome_table import OutcomeTableError, table_of_campaign
from ds_orchestrator.prediction.real.records import RecordError, read_drives
from ds_orchestrator.prediction.real.update import margin_drives
from ds_orchestrator.prediction.self_check import check_in_turn
from ds_orchestrator.prediction.sources import as_population
from ds_orchestrator.prediction.span import span_of
from ds_orchestrator.prediction.twin_prediction import predict_twin
from ds_orchestrator.prediction.verdicts import ERROR_RATE, CellVerdict, Verdicts, judge
from ds_orchestrator.report.findings import count
from ds_orchestrator.search.features import feature_of
from ds_orchestrator.store.sqlite_file import StoreError


@dataclass(frozen=True, kw_only=True)
class AnswerPanel:
    """One map over two axes.

    Attributes:
        title: bin of a third axis, or "".
        columns: labels of the first axis' bins.
        rows: label of each bin of the second axis, from the largest, and its cells; None without one.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[tuple[str, Sequence[CellVerdict | None]]]


@dataclass(frozen=True, kw_only=True)
class AnswerSection:
    """What is predicted of a car, for a page.

    Attributes:
        sentence: the answer in one line; why there is none, if there are no panels.
        reading: how to read the map.
        warnings: whether the car is outside of what the siblings span, and which calls not to rely on.
        axes: titles of the first two axes.
        panels: the map; several for maps of three axes.
    """

    sentence: str
    reading: str = ""
    warnings: Sequence[str] = ()
    axes: tuple[str, str] = ("", "")
    panels: Sequence[AnswerPanel] = ()


def answer_section(folder: Path, data: CampaignData) -> AnswerSection:
    """Predict the car from a campaign, its refinement and its real drives; a twin counts as one more simulator.

    Args:
        folder: campaign folder.
        data: contents of its store.
    """
    try:
        refined = with_refinement(folder, data)
        drives = read_drives(folder)
        table = as_population(table_of_campaign(refined))
        prediction = predict_twin(table)
        prediction = prediction.updated(margin_drives(table, drives))
    except (OutcomeTableError, RecordError, StoreError) as error:
        return AnswerSection(sentence=f"No prediction for a car: {error}.")
    verdicts = judge(table, prediction, tuple(data.config.features))
    check = check_in_turn(table)
    new = sum(is_refined(test.test_id) for test in refined.tests)
    titles = [feature_of(name).title for name in verdicts.features]
    return AnswerSection(
        sentence=_sentence(verdicts, table.siblings, len(drives), sum(drive.failed for drive in drives)),
        reading=f"{_reading(verdicts, new, len(drives))} {check.sentence}.",
        warnings=[text for text in (span_of(prediction).warning, check.warning) if text],
        axes=(titles[0], titles[1]),
        panels=_panels(verdicts),
    )


def _sentence(verdicts: Verdicts, simulators: Sequence[str], drives: int, failed: int) -> str:
    counts = verdicts.counts
    tested = sum(counts.values()) - counts["untested"]
    share = float(np.mean([one.probability for one in verdicts.tests]))
    known = f"after {count(drives, 'real drive')}, {failed} failed" if drives else "without a real drive"
    named = simulators[0] if len(simulators) == 1 else f"{', '.join(simulators[:-1])} and {simulators[-1]}"
    fail, safe, disputed = (counts[name] for name in ("fails", "safe", "disputed"))
    return (
        f"On a car, predicted from {named} {known}: {fail} of {count(tested, 'cell')} fail{'s' if fail == 1 else ''}, "
        f"{safe} {'is' if safe == 1 else 'are'} safe, {disputed} {'is' if disputed == 1 else 'are'} disputed; "
        f"{100 * share:.0f} % of these tests are expected to fail."
    )


def _reading(verdicts: Verdicts, new: int, drives: int) -> str:
    added = f" {count(new, 'test')} of a refinement are counted." if new else ""
    framed = " Framed cells were driven by the car." if drives else ""
    tolerated, wrong = (f"{100 * rate:.0f} %" for rate in (verdicts.tolerated, ERROR_RATE))
    return (
        f"A cell fails if more than {tolerated} of tests like its own would fail on the car, and is safe if fewer "
        f"would; either is meant to be wrong at most {wrong} of the time, if the car is one more simulator of this "
        "kind. Where that cannot be said, it is disputed. Numbers: mean failure rate, 90 % interval, tests."
        f"{framed}{added}"
    )


def _panels(verdicts: Verdicts) -> list[AnswerPanel]:
    across, up = (feature_of(name) for name in verdicts.features[:2])
    panels = []
    for third in sorted({one.cell[2:] for one in verdicts.cells if one.tests}):
        cells = {one.cell[:2]: one for one in verdicts.cells if one.cell[2:] == third}
        columns, rows = sorted({a for a, _ in cells}), sorted({b for _, b in cells}, reverse=True)
        panels.append(
            AnswerPanel(
                title=", ".join(
                    f"{feature_of(name).title} {feature_of(name).label(bin_)}"
                    for name, bin_ in zip(verdicts.features[2:], third, strict=True)
                ),
                columns=[across.label(a) for a in columns],
                rows=[(up.label(b), [cells.get((a, b)) for a in columns]) for b in rows],
            )
        )
    return panels
