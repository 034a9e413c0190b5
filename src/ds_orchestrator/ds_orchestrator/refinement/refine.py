"""Drives new tests of disputed cells on the siblings until these are settled there, or a budget is spent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ds_orchestrator.campaign.campaign_data import CampaignData
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.refined_data import FOLDER, MOST_TESTS, is_refined, refined_config, with_refinement
from ds_orchestrator.comparison.given_tests import Engine, drive_tests
from ds_orchestrator.prediction.outcome_table import State, table_of_campaign
from ds_orchestrator.prediction.twin_prediction import predict_twin
from ds_orchestrator.prediction.verdicts import CellVerdict, Verdicts, judge
from ds_orchestrator.refinement.candidates import Candidates
from ds_orchestrator.refinement.evidence import CellEvidence, evidence_of
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Test

TESTS_A_ROUND = 8
"""New tests between two fits of the model; chosen: enough to keep several workers busy, few enough that a cell gets no
tests that it needs no more. The number of workers has no part in it, so that results do not depend on it."""

Work = dict[str, list[Test]]
"""Sibling -> tests to drive there."""


class RefinementError(ValueError):
    """A budget, or a campaign, with which no cell can be refined."""


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """What is known of the cells at one moment.

    Attributes:
        data: the campaign with its refinement.
        verdicts: predictions of a simulator, or a car, that was never driven.
        evidence: cell -> drives on the siblings, of every cell with tests.
    """

    data: CampaignData
    verdicts: Verdicts
    evidence: Mapping[Cell, CellEvidence]

    @property
    def targets(self) -> list[CellVerdict]:
        """Disputed cells that are not settled on the siblings, the widest interval first."""
        found = [
            one for one in self.verdicts.cells if one.verdict == "disputed" and not self.evidence[one.cell].settled
        ]
        return sorted(found, key=lambda one: (-round(_width(one), 9), one.cell))


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """What a refinement did.

    Attributes:
        budget: drives that it was allowed.
        spent: drives that it used, errors and excluded tests included.
        tests: tests that it added.
        in_error: drives without a verdict after all attempts.
        before: the cells before.
        after: the cells now.
        barren: cells for which no new test could be made.
    """

    budget: int
    spent: int
    tests: int
    in_error: int
    before: Assessment
    after: Assessment
    barren: Sequence[Cell]

    @property
    def stopped(self) -> str:
        """Why it ended, in one line."""
        left = [one.cell for one in self.after.targets if one.cell not in self.barren]
        if left:
            return (
                f"the budget is spent: {len(left)} disputed cells are not settled on the siblings, see `tests needed`"
            )
        if self.after.targets:
            return f"no new tests of {len(self.barren)} cells could be made; all other disputed cells are settled"
        return "every disputed cell is settled on the siblings: only drives on the car tell more"

    @property
    def sentence(self) -> str:
        """What it did, in one line."""
        disputed = [of.verdicts.counts["disputed"] for of in (self.before, self.after)]
        return (
            f"{self.tests} new tests, {self.spent} of {self.budget} drives: {disputed[0]} disputed cells before, "
            f"{disputed[1]} now, {len(self.before.targets)} and {len(self.after.targets)} of them not settled on the "
            "siblings"
        )

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "budget": self.budget, "spent": self.spent, "tests": self.tests, "in_error": self.in_error,
            "sentence": self.sentence, "stopped": self.stopped, "cells": cell_rows(self.before, self.after),
        }  # fmt: skip


def cell_rows(before: Assessment, after: Assessment) -> list[dict[str, Any]]:
    """JSON values of every cell that is disputed at one of two moments."""
    earlier = {one.cell: one for one in before.verdicts.cells}
    return [
        {
            "cell": list(one.cell),
            "before": earlier[one.cell].verdict if one.cell in earlier else "untested",
            "verdict": one.verdict,
            "rate": one.rate,
            "interval": one.interval,
            "siblings": after.evidence[one.cell].document(),
            "new_tests": sum(
                is_refined(test.test_id) and after.data.cells.get(test.test_id) == one.cell for test in after.data.tests
            ),
        }
        for one in after.verdicts.cells
        if one.tests and "disputed" in (one.verdict, earlier[one.cell].verdict if one.cell in earlier else "")
    ]


def assess(folder: Path, campaign: CampaignData, *, tolerated: float) -> Assessment:
    """Predict and count every cell of a campaign with its refinement.

    Raises:
        ds_orchestrator.prediction.outcome_table.OutcomeTableError: too few tests.
        ds_orchestrator.store.sqlite_file.StoreError: the refinement's file is damaged.
    """
    data = with_refinement(folder, campaign)
    table = table_of_campaign(data)
    verdicts = judge(table, predict_twin(table), tuple(data.config.features), tolerated=tolerated)
    cells = [one.cell for one in verdicts.cells if one.tests]
    evidence = {one.cell: one for one in evidence_of(table, cells, tolerated=tolerated)}
    return Assessment(data=data, verdicts=verdicts, evidence=evidence)


def check_budget(config: CampaignConfig, budget: int) -> None:
    """Refuse a budget that is no test's.

    Raises:
        RefinementError: it is below one drive on every sibling.
    """
    each = len(config.siblings)
    if budget < each:
        raise RefinementError(
            f"--budget {budget}: a test takes {each} drives, one on each of {', '.join(config.siblings)}: expected at "
            f"least {each}"
        )


def refine(
    folder: Path, campaign: CampaignData, config: CampaignConfig, budget: int, engine: Engine, *, tolerated: float
) -> Refinement:
    """Refine the disputed cells of a campaign; what is driven is kept in its folder, stopped or not.

    Args:
        folder: campaign folder.
        campaign: contents of its store, without the refinement.
        config: of the campaign, with the engine and number of workers to use.
        budget: drives at most.
        engine: what drives.
        tolerated: failure rate up to which a cell counts as safe.

    Raises:
        RefinementError: an impossible budget, or no cell to refine.
        ds_orchestrator.campaign.runner.Stopped: the user stopped it; what was finished is kept.
    """
    check_budget(config, budget)
    config = refined_config(config)
    before = now = assess(folder, campaign, tolerated=tolerated)
    spent = in_error = 0
    barren: set[Cell] = set()
    known = {test.test_id for test in now.data.tests}
    work = begun_work(now.data, budget)
    while True:
        if not work:
            work = _next_round(now, config, budget - spent, barren)
        if not work:
            break
        drives = sum(map(len, work.values()))
        engine.say(
            f"{drives} drives of {len({t.test_id for of in work.values() for t in of})} tests; {spent} of {budget} "
            f"drives spent, {len(now.targets)} disputed cells not settled on the siblings"
        )
        found = drive_tests(config, work, folder / FOLDER, engine)
        spent, in_error, work = spent + drives, in_error + len(found.errors), {}
        now = assess(folder, campaign, tolerated=tolerated)
    return Refinement(
        budget=budget,
        spent=spent,
        tests=sum(test.test_id not in known for test in now.data.tests),
        in_error=in_error,
        before=before,
        after=now,
        barren=sorted(barren),
    )


def begun_work(data: CampaignData, budget: int) -> Work:
    """Drives that a refinement began and did not finish, or that ended in an error, within a budget."""
    done = {(one.test_id, one.simulator) for one in data.verdicts} | set(data.excluded)
    work: Work = {}
    for test in data.tests:
        for name in data.config.siblings:
            if is_refined(test.test_id) and (test.test_id, name) not in done and budget > 0:
                work.setdefault(name, []).append(test)
                budget -= 1
    return work


def _next_round(now: Assessment, config: CampaignConfig, left: int, barren: set[Cell]) -> Work:
    """Tests of the next round: one cell after the other gets what it needs, until the round is full.

    Cells that the budget can settle come first, so that a rate near the tolerated one does not swallow it; among them,
    and among the others, the most uncertain ones.
    """
    each = len(config.siblings)
    candidates = Candidates(now.data)
    number = sum(is_refined(test.test_id) for test in now.data.tests)
    needed = {one.cell: now.evidence[one.cell].tests_needed or MOST_TESTS for one in now.targets}
    targets = [one.cell for one in now.targets if one.cell not in barren]
    work: Work = {}
    tests = 0
    for cell in sorted(targets, key=lambda cell: needed[cell] * each > left):  # stable
        waiting = _undriven(now.data, cell)
        for _ in range(min(needed[cell], TESTS_A_ROUND - tests)):
            on = waiting[0][1] if waiting else list(config.siblings)
            if len(on) > left:
                return work
            made = waiting.pop(0)[0] if waiting else candidates.new_test(cell, number) if number < MOST_TESTS else None
            if made is None:
                barren.add(cell)
                break
            number += is_refined(made.test_id)
            for name in on:
                work.setdefault(name, []).append(made)
            left, tests = left - len(on), tests + 1
    return work


def _undriven(data: CampaignData, cell: Cell) -> list[tuple[Test, list[str]]]:
    """Tests of a cell that did not migrate, and the siblings that never drove them; only elites may migrate."""
    if not data.config.elites_only:
        return []
    table = table_of_campaign(data)
    found = []
    for row, test in enumerate(data.tests):
        states = {name: table.states[row, table.column(name)] for name in table.siblings}
        missing = [name for name, state in states.items() if state == State.MISSING]
        if table.cells[row] == cell and missing and not {State.EXCLUDED, State.ERROR} & set(states.values()):
            found.append((test, missing))
    return found


def _width(cell: CellVerdict) -> float:
    return 0.0 if cell.interval is None else cell.interval[1] - cell.interval[0]
