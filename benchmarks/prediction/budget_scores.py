"""Scores predictors of a twin after a few drives on it, and tabulates the scores pooled over twins and tests.

For `benchmarks.prediction.real_budget` and `benchmarks.prediction.campaign_budget`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import expit, log_expit, logit

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import Array, Bools
from ds_analysis.common.table import Column, Table
from ds_analysis.prediction.calibration import forecast_cells, share_held
from ds_analysis.prediction.predictors import HIERARCHICAL, SINGLE, UNDRIVEN, merged, undriven_probabilities
from ds_analysis.prediction.real.drive_choice import LEAST_GAIN, candidates_of, choose, next_gain
from ds_analysis.prediction.twin_prediction import ODDS, TwinPrediction, outcomes_of, predict_twin, span_of
from ds_analysis.prediction.verdicts import called

Errors = dict[str, Array]
"""Predictor -> (tests,) squared errors."""

BUDGETS = (0, 2, 4, 8, 16)
RULES = ("information", "disagreement", "random")
CHOICES = 10
"""Random choices, and orders of equal disagreement, whose mean is taken."""
SEED = 17
"""Of twins, roads and choices; another one than that of the comparisons on which the model was made."""

RATE = "rate of the drives"
SHIFTED = "undriven features, shifted"
LEARNERS = (RATE, SHIFTED)
SHIFT_SCALE = 2.5
"""Standard deviation of the shift's prior in logits; the weakly informative scale of Gelman et al., Ann. Appl. Stat.
2(4), 2008."""
LARGEST_SHIFT = 6 * SHIFT_SCALE


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
    outcomes = {one.row: one for one in outcomes_of(table, str(table.twin))}
    driven = [table.failed(name).astype(np.float64) for name in table.siblings]
    fixed = merged(driven)
    fixed[UNDRIVEN] = undriven_probabilities(table, "all")
    fixed[SINGLE] = undriven_probabilities(table, "best")
    plain = {name: (p - truth) ** 2 for name, p in fixed.items()}
    plain["one sibling"] = ((np.array(driven) - truth) ** 2).mean(axis=0)  # mean of the siblings' own scores
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
                updated, rows = updated.updated([outcomes[row] for row in more]), [*rows, *more]
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
    drives, outcomes = 0, {one.row: one for one in outcomes_of(table, str(table.twin))}
    while drives < BUDGETS[-1]:
        gain = next_gain(table, prediction)
        if gain is None or gain < LEAST_GAIN:
            break
        (choice,) = choose(table, prediction, 1)
        prediction, drives = prediction.updated([outcomes[choice.row]]), drives + 1
    return drives, float(((prediction.probabilities() - truth) ** 2).mean())


def _calls(probabilities: Array, truth: Array, rows: Bools) -> tuple[int, int, int, int]:
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


def learned(undriven: Array, truth: Array, rows: Sequence[int]) -> Mapping[str, Array]:
    """Predict all tests from the outcomes of driven ones, in simpler ways than the hierarchical model does.

    A few drives tell how bad a car is, whatever else they tell; the model has to be better than what follows from that.
    Added after the first results of `benchmarks.prediction.real_budget`, before any of their own.

    Args:
        undriven: (tests,) probabilities of failure by road features and conditions.
        truth: (tests,) 1.0 where the car fails; only driven tests are looked at.
        rows: driven tests.

    Returns:
        Predictor -> (tests,) probabilities; driven tests have their outcomes. `RATE` is the mean of Jeffreys'
        posterior, the same for all other tests; `SHIFTED` adds one number to the features' logits, the mode of its
        posterior.
    """
    known = truth[list(rows)]
    logits = logit(undriven)

    def loss(shift: float) -> float:
        moved = logits[list(rows)] + shift
        likelihood = known @ log_expit(moved) + (1.0 - known) @ log_expit(-moved)
        return 0.5 * (shift / SHIFT_SCALE) ** 2 - float(likelihood)

    shift = float(minimize_scalar(loss, bounds=(-LARGEST_SHIFT, LARGEST_SHIFT), method="bounded").x)
    rate = (float(known.sum()) + 0.5) / (len(known) + 1.0)
    found = {RATE: np.full(len(truth), rate), SHIFTED: expit(logits + shift)}
    for probabilities in found.values():
        probabilities[list(rows)] = known
    return found


AIM = 4
"""Budget at which the aim is judged."""
RESAMPLES = 2000


def pooled(errors: Sequence[tuple[Case, Array]]) -> tuple[float, tuple[float, float]]:
    """Mean over twins and tests of a squared error, or of a difference of two, with its 95 % interval.

    The interval resamples twins and clusters of tests: of the errors of a cluster only their sum and number matter.
    """
    clusters = sorted({cluster for case, _ in errors for cluster in case.clusters})
    place = {cluster: k for k, cluster in enumerate(clusters)}
    values, known = np.zeros((len(errors), len(clusters))), np.zeros((len(errors), len(clusters)))
    for k, (case, of) in enumerate(errors):
        columns = [place[cluster] for cluster in case.clusters]
        np.add.at(values[k], columns, of)
        np.add.at(known[k], columns, 1.0)
    rng = np.random.default_rng(SEED)
    twins = rng.multinomial(len(errors), np.full(len(errors), 1 / len(errors)), RESAMPLES).astype(np.float64)
    tests = rng.multinomial(len(clusters), np.full(len(clusters), 1 / len(clusters)), RESAMPLES).astype(np.float64)
    means = np.einsum("bt,tr,br->b", twins, values, tests, optimize=True)
    means /= np.maximum(np.einsum("bt,tr,br->b", twins, known, tests, optimize=True), 1.0)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(values.sum() / known.sum()), (float(low), float(high))


def tables_of(scored: Sequence[Scored]) -> list[Table]:
    """Tabulate the groups that have a twin, over all networks; one group counts made twins that fail alike once."""
    alike: dict[tuple[object, ...], Scored] = {}
    for one in scored:
        if one.case.group == "made":
            table = one.case.table
            failed = table.failed(str(table.twin)).tobytes()
            alike.setdefault((one.case.network, table.test_ids, failed), one)
    groups = {
        "in turn": [one for one in scored if one.case.group == "in turn"],
        "made": [one for one in scored if one.case.group == "made"],
        "made, distinct": list(alike.values()),
        "made, within": [one for one in scored if one.case.group == "made" and not one.case.outside],
        "made, outside": [one for one in scored if one.case.outside],
        "control": [one for one in scored if one.case.group == "control"],
    }
    groups = {name: of for name, of in groups.items() if of}
    tables = _budget_table, _baseline_table, _learner_table, _calibration_table, _stop_table, _span_table
    return [table(groups) for table in tables]


def _budget_table(groups: Mapping[str, Sequence[Scored]]) -> Table:
    rows = []
    for group, of in groups.items():
        for budget in BUDGETS:
            by_rule = {r: [(one.case, one.after[r, budget][HIERARCHICAL]) for one in of] for r in RULES}
            cells: list[Any] = [pooled(by_rule[rule])[0] for rule in RULES]
            for other in RULES[1:]:
                cells += pooled([(c, e - f) for (c, e), (_, f) in zip(by_rule[RULES[0]], by_rule[other], strict=True)])
            change = [(one.case, one.after[RULES[0], budget][HIERARCHICAL] - one.plain[HIERARCHICAL]) for one in of]
            rows.append((group, len(of), budget, *cells, *pooled(change)))
    return Table(
        name="budgets",
        title="Brier score of the hierarchical model after a few drives on the twin",
        columns=[
            Column("twins"), Column("number", "count"), Column("drives", "count"),
            *(Column(rule, "number") for rule in RULES),
            Column("minus disagreement", "number"), Column("95 %", "number"),
            Column("minus random", "number"), Column("95 % of it", "number"),
            Column("minus no drive", "number"), Column("95 % of that", "number"),
        ],
        rows=rows,
    )  # fmt: skip


def _baseline_table(groups: Mapping[str, Sequence[Scored]]) -> Table:
    rows = []
    for group, of in groups.items():
        for name in of[0].plain:
            row: list[Any] = [group, name, pooled([(one.case, one.plain[name]) for one in of])[0]]
            for budget in (0, AIM):
                ours = [one.after["information", budget] for one in of]
                own = pooled([(one.case, e[HIERARCHICAL] - one.plain[name]) for one, e in zip(of, ours, strict=True)])
                row += own if name != HIERARCHICAL or budget else (None, None)
            filled = [(one.case, one.after["information", AIM]) for one in of]
            row += pooled([(c, e[HIERARCHICAL] - e[name]) for c, e in filled]) if name != HIERARCHICAL else (None, None)
            rows.append(tuple(row))
    return Table(
        name="baselines",
        title=f"Hierarchical model without a drive, and after {AIM} by expected information, minus each predictor",
        columns=[
            Column("twins"), Column("predictor"), Column("its Brier score", "number"),
            Column("model, no drive, minus it", "number"), Column("95 %", "number"),
            Column(f"after {AIM}, minus it", "number"), Column("95 % ", "number"),
            Column(f"after {AIM}, minus it with these outcomes", "number"), Column("95 %  ", "number"),
        ],
        rows=rows,
    )  # fmt: skip


def _learner_table(groups: Mapping[str, Sequence[Scored]]) -> Table:
    rows = []
    for group, of in groups.items():
        ours = [one.after["information", AIM][HIERARCHICAL] for one in of]
        for name in LEARNERS:
            for rule in ("information", "random"):
                theirs = [(one.case, one.after[rule, AIM][name]) for one in of]
                less = [(case, own - error) for own, (case, error) in zip(ours, theirs, strict=True)]
                rows.append((group, name, rule, pooled(theirs)[0], *pooled(less)))
    return Table(
        name="learners",
        title=f"Hierarchical model after {AIM} by expected information, minus simpler ways to learn from {AIM}",
        columns=[
            Column("twins"), Column("predictor"), Column("drives chosen by"), Column("its Brier score", "number"),
            Column("model minus it", "number"), Column("95 %", "number"),
        ],
        rows=rows,
    )  # fmt: skip


def _calibration_table(groups: Mapping[str, Sequence[Scored]]) -> Table:
    rows: list[tuple[Any, ...]] = []
    for group, of in groups.items():
        ranks = [rank for one in of for rank in one.ranks]
        held = share_held(ranks)
        for budget in (0, AIM):
            counts = np.array([one.calls[budget] for one in of]).sum(axis=0).tolist()
            rows.append((group, len(ranks) if not budget else None, held if not budget else None, budget, *counts))
    return Table(
        name="calibration",
        title="Cells whose 90 % forecast holds the twin's rate, and tests called safe or failing that were not driven",
        columns=[
            Column("twins"), Column("cells", "count"), Column("held", "number"), Column("drives", "count"),
            Column("called safe", "count"), Column("of them fail", "count"),
            Column("called failing", "count"), Column("of them do not", "count"),
        ],
        rows=rows,
    )  # fmt: skip


def _stop_table(groups: Mapping[str, Sequence[Scored]]) -> Table:
    rows: list[tuple[Any, ...]] = [
        (
            group, len(of), float(np.mean([one.stopped[0] for one in of])),
            f"{min(one.stopped[0] for one in of)} to {max(one.stopped[0] for one in of)}",
            float(np.mean([one.plain[HIERARCHICAL].mean() for one in of])),
            *(float(np.mean([one.stopped[k] for one in of])) for k in (1, 2)),
        )
        for group, of in groups.items()
    ]  # fmt: skip
    return Table(
        name="stop",
        title=f"Drives until the rule says to stop, at most {BUDGETS[-1]}; mean of the twins' Brier scores",
        columns=[
            Column("twins"), Column("number", "count"), Column("drives", "number"), Column("range"),
            Column("before", "number"), Column("when it stops", "number"), Column(f"after {BUDGETS[-1]}", "number"),
        ],
        rows=rows,
    )  # fmt: skip


def _span_table(groups: Mapping[str, Sequence[Scored]]) -> Table:
    rows = [
        (
            one.case.network, group, one.case.name, len(one.case.table),
            int(one.case.table.failed(str(one.case.table.twin)).sum()),
            *(int(one.case.table.failed(name).sum()) for name in one.case.table.siblings),
            float(one.plain[HIERARCHICAL].mean()), float(one.after["information", AIM][HIERARCHICAL].mean()),
            one.odds[AIM], "yes" if one.odds[AIM] > ODDS else "no",
        )
        for group, of in groups.items()
        if not group.startswith("made, ")
        for one in of
    ]  # fmt: skip
    return Table(
        name="twins",
        title=f"Each twin: failures, Brier score before and after {AIM} drives, and whether it is said to be outside",
        columns=[
            Column("network"), Column("twins"), Column("twin"), Column("tests", "count"), Column("fails", "count"),
            *(Column(f"sibling {k}", "count") for k in (1, 2, 3)),
            Column("Brier before", "number"), Column(f"after {AIM}", "number"),
            Column("odds", "number"), Column("said to be outside"),
        ],
        rows=rows,
    )  # fmt: skip
