"""Scores predictors of a twin after a few drives on it.

For `benchmarks.prediction.real_budget` and `benchmarks.prediction.campaign_budget`, which tabulate the scores by
`benchmarks.prediction.budget_tables`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from benchmarks.prediction.drive_learners import learned
from numpy.typing import NDArray

from ds_analysis.prediction.coverage import forecast_cells
from ds_analysis.prediction.margins import margin
from ds_analysis.prediction.outcome_table import OutcomeTable
from ds_analysis.prediction.predictors import HIERARCHICAL, SINGLE, UNDRIVEN
from ds_analysis.prediction.real.selection import candidates_of, choose
from ds_analysis.prediction.real.worth import LEAST_GAIN, next_gain
from ds_analysis.prediction.span import span_of
from ds_analysis.prediction.twin_prediction import MarginDrive, TwinPrediction, predict_twin
from ds_analysis.prediction.undriven import undriven_probabilities
from ds_analysis.prediction.verdicts import called
from ds_orchestrator.maps.algebra import OPERATORS

Array = NDArray[np.float64]
Errors = dict[str, Array]
"""Predictor -> (tests,) squared errors."""

BUDGETS = (0, 2, 4, 8, 16)
RULES = ("information", "disagreement", "random")
CHOICES = 10
"""Random choices, and orders of equal disagreement, whose mean is taken."""
SEED = 17
"""Of twins, roads and choices; another one than that of the comparisons on which the model was made."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A twin of one network.

    Attributes:
        network: the driver.
        group: `in turn`, `made` or `control`.
        name: of the twin.
        outside: the value of a made twin that is far outside, or "".
        table: outcomes, with the twin.
        clusters: per test what is resampled with it, such as its road or its family; the same for all twins.
    """

    network: str
    group: str
    name: str
    outside: str
    table: OutcomeTable
    clusters: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A twin's squared errors, per test.

    Attributes:
        case: the twin.
        plain: predictor -> errors without any drive.
        after: rule and budget -> predictor -> errors after the drives, driven tests being known to all predictors;
            predictors that learn from the drives are here, too.
        odds: budget -> odds that the twin is outside of the siblings' span, drives chosen by expected information.
        ranks: randomised ranks of the cells' failure rates in their forecasts, without a drive.
        calls: budget -> tests that were not driven and are called safe, those of them that fail, tests called failing,
            and those of them that do not; drives chosen by expected information.
        stopped: drives until the rule of `ds real update` says to stop, each chosen with those before known, at most
            the largest budget; Brier score then, and after the largest budget.
    """

    case: Case
    plain: Errors
    after: Mapping[tuple[str, int], Errors]
    odds: Mapping[int, float]
    ranks: Sequence[float]
    calls: Mapping[int, tuple[int, int, int, int]]
    stopped: tuple[int, float, float]


def score(case: Case) -> Scored:
    """Score every predictor of a twin after every budget, by every rule."""
    table = case.table
    truth = table.failed(str(table.twin)).astype(np.float64)
    prediction = predict_twin(table)
    driven = np.array([table.failed(name).astype(np.float64) for name in table.siblings])
    fixed = {name: operator.combine(driven, np.ones(len(driven))) for name, operator in OPERATORS.items()}
    fixed[UNDRIVEN] = undriven_probabilities(table, "all")
    fixed[SINGLE] = undriven_probabilities(table, "best")
    plain = {name: (p - truth) ** 2 for name, p in fixed.items()}
    plain["one sibling"] = ((driven - truth) ** 2).mean(axis=0)  # mean of the siblings' own scores
    plain[HIERARCHICAL] = (prediction.probabilities() - truth) ** 2
    after: dict[tuple[str, int], Errors] = {}
    odds: dict[int, float] = {}
    calls: dict[int, tuple[int, int, int, int]] = {}
    ranks = [float(one.rank) for one in forecast_cells(table, prediction) if one.rank is not None]
    for rule in RULES:
        choices = 1 if rule == "information" else CHOICES
        sums: dict[int, Errors] = {budget: {} for budget in BUDGETS}
        for choice in range(choices):
            rng = np.random.default_rng([SEED, choice])
            order = _order(rule, table, rng)
            updated = prediction
            rows: list[int] = []
            for budget in BUDGETS:
                if order is None:
                    left = len(candidates_of(table, updated))
                    more = [one.row for one in choose(table, updated, min(budget - len(rows), left))]
                else:
                    more = order[len(rows) : budget]
                updated, rows = updated.updated([_outcome(table, row) for row in more]), [*rows, *more]
                hidden = np.ones(len(table))
                hidden[rows] = 0.0
                errors = {name: squared * hidden for name, squared in plain.items()}
                errors[HIERARCHICAL] = (updated.probabilities() - truth) ** 2
                errors |= {name: (p - truth) ** 2 for name, p in learned(fixed[UNDRIVEN], truth, rows).items()}
                for name, squared in errors.items():
                    sums[budget][name] = sums[budget].get(name, np.zeros(len(table))) + squared / choices
                if order is None:
                    odds[budget] = span_of(updated).odds
                    calls[budget] = _calls(updated.probabilities(), truth, hidden > 0.0)
        after |= {(rule, budget): errors for budget, errors in sums.items()}
    last = float(after["information", BUDGETS[-1]][HIERARCHICAL].mean())
    drives, brier = _stopped(table, prediction, truth)
    stopped = drives, brier, last
    return Scored(case=case, plain=plain, after=after, odds=odds, ranks=ranks, calls=calls, stopped=stopped)


def _stopped(table: OutcomeTable, prediction: TwinPrediction, truth: Array) -> tuple[int, float]:
    """Drives until another one is not worth its while, and the Brier score then."""
    drives = 0
    while drives < BUDGETS[-1]:
        gain = next_gain(table, prediction)
        if gain is None or gain < LEAST_GAIN:
            break
        (choice,) = choose(table, prediction, 1)
        prediction, drives = prediction.updated([_outcome(table, choice.row)]), drives + 1
    return drives, float(((prediction.probabilities() - truth) ** 2).mean())


def _calls(probabilities: Array, truth: Array, rows: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    safe, fails = (rows & one for one in called(probabilities))
    failed = truth > 0.0
    return int(safe.sum()), int((safe & failed).sum()), int(fails.sum()), int((fails & ~failed).sum())


def _order(rule: str, table: OutcomeTable, rng: np.random.Generator) -> list[int] | None:
    """Rows in the order in which they are driven; None if it depends on the outcomes."""
    if rule == "information":
        return None
    order = rng.permutation(len(table))
    if rule == "disagreement":
        mean = np.mean([table.failed(name) for name in table.siblings], axis=0)
        order = order[np.argsort(np.abs(mean[order] - 0.5), kind="stable")]
    return [int(row) for row in order]


def _outcome(table: OutcomeTable, row: int) -> MarginDrive:
    column = table.column(str(table.twin))
    failed = bool(table.failed(str(table.twin))[row])
    known = margin(table.lateral[row : row + 1, column], table.half_lanes[row : row + 1])
    return MarginDrive(row=row, failed=failed, margin=None if failed else float(known[0]))
