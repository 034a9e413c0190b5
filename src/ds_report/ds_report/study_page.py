# SPDX-License-Identifier: Apache-2.0
"""Page of a study of imported outcomes: one HTML file that opens offline."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np

from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError
from ds_analysis.common.selection import SEED, choose_split
from ds_analysis.failure_patterns import nesting
from ds_analysis.outcomes.study import Study
from ds_analysis.outcomes.study_results import maps_of_study
from ds_analysis.prediction.car import predict_car
from ds_analysis.prediction.mixture import predict
from ds_analysis.prediction.predictors import compare_predictors, comparison_tables
from ds_base.installation import ds_command
from ds_base.table import Column, Table, styled
from ds_orchestrator.maps.feature_map import slices_of
from ds_report.heatmap import bounds_of, draw_map, draw_verdicts
from ds_report.pages import data_address, write_page
from ds_sim.registry import SimulatorName

PAGE = "report.html"


def write_study_page(folder: Path, study: Study) -> Path:
    """Write the page into a study's folder; the same study and drives give the same bytes."""
    table = study.table()
    try:
        car = predict_car(folder, table)
        unpredicted = ""
    except OutcomeTableError as error:
        car, unpredicted = None, str(error)
    about_car = [one.sentence for one in (car.help, car.certificate) if one] if car is not None and car.drives else []
    tables = []
    if study.twin is not None and car is not None:
        try:
            tables = comparison_tables(compare_predictors(table, predict(table)))
        except OutcomeTableError as error:
            unpredicted = str(error)
    shown = {map_id: feature_map for map_id, feature_map in maps_of_study(study).items() if not map_id.operator}
    bounds = bounds_of(shown.values())
    return write_page(
        folder / PAGE,
        "study.html.j2",
        title=folder.resolve().name,
        sentence=f"{len(table)} tests on {', '.join(study.simulators)}" if car is None else car.sentence,
        sentences=[*about_car, *(_where(table, name) for name in table.simulators)],
        unpredicted=unpredicted,
        command=str(ds_command("real", "propose", folder)),
        simulators=simulator_table(study),
        pairs=pair_table(table),
        maps=[
            (part.title, data_address(draw_map(part, "probability", bounds=bounds)))
            for feature_map in shown.values()
            for part in slices_of(feature_map)
        ],
        verdicts="" if car is None else data_address(draw_verdicts(car.verdicts, "Predicted failures on a car")),
        tables=tables,
        features=study.features,
    )


def _where(table: OutcomeTable, name: SimulatorName) -> str:
    """Say on how many tests a simulator fails, and where, if a feature divides them better than chance."""
    judged = table.select(table.known(name))
    failed = judged.failed(name)
    said = f"{name} fails on {int(failed.sum())} of {len(judged)} tests"
    columns = list(zip(judged.feature_names, judged.features.T, strict=True))
    axes = [(feature, values, sign) for sign in (1, -1) for feature, values in columns]
    families = np.unique(judged.families, return_inverse=True)[1]
    split = choose_split(axes, failed, families, np.random.default_rng(SEED))
    if split is None or split.apart is None or not split.is_clear:
        return f"{said}; no feature divides them better than chance."
    low, high = (f"{one.failures / one.tests:.0%}" for one in split.apart[::-1])
    beyond, harder = int(failed[split.harder].sum()), int(split.harder.sum())
    side = f"{split.threshold:.3g} or {'more' if split.is_lower_bound else 'less'}"
    where = f"{beyond} of the {harder} where {split.axis} is {side}"
    return f"{said}: {where}. On tests that did not choose this threshold, {high} fail beyond it and {low} elsewhere."


def simulator_table(study: Study) -> Table:
    """Tabulate what was read of each simulator, and of the car."""
    roles = {study.twin: "twin", study.car: "car"}
    rows = [
        (f"{name} ({roles[name]})" if name in roles else name, tests, drives, failed, flaky)
        for name, (tests, drives, failed, flaky) in study.flakiness().items()
    ]
    return Table(
        name="simulators",
        title="What was read",
        columns=[
            Column("simulator"),
            *styled("count", "tests", "drives"),
            *styled("number", "failed", "tests whose repeats disagree"),
        ],
        rows=rows,
    )


def pair_table(table: OutcomeTable) -> Table:
    """Tabulate for each pair of simulators how many failures of one are failures of the other, too."""
    rows = []
    for pair in combinations(table.simulators, 2):
        both = np.all([table.known(name) for name in pair], axis=0)
        if both.any():
            rows.append(tuple(vars(nesting(table.select(both), *pair)).values()))
    return Table(
        name="pairs",
        title="Whose failures lie inside whose",
        columns=[
            *styled("text", "first", "second"),
            *styled("count", "both fail", "only the first", "only the second", "none"),
            *styled("number", "second fails where the first does", "95%", "first fails where the second does", "95% "),
        ],
        rows=rows,
    )
