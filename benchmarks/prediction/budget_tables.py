"""Tabulates the scores of `benchmarks.prediction.budget_scores`, pooled over twins and tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from benchmarks.prediction.budget_scores import BUDGETS, RULES, SEED, Array, Case, Scored
from benchmarks.prediction.drive_learners import LEARNERS

from ds_analysis.common.table import Column, Table
from ds_analysis.prediction.coverage import share_held
from ds_analysis.prediction.predictors import HIERARCHICAL
from ds_analysis.prediction.span import ODDS

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
