"""Page of a study of imported outcomes: one HTML file that opens offline."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np

from ds_analysis.common.heatmap import bounds_of, draw_map
from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError
from ds_analysis.common.table import Column, Table
from ds_analysis.outcomes.maps import maps_of_study
from ds_analysis.outcomes.study import Study
from ds_analysis.prediction.car import predict_car
from ds_analysis.prediction.predictor_scores import compare_predictors, comparison_tables
from ds_analysis.prediction.twin_prediction import predict_twin, span_of
from ds_analysis.prediction.verdict_picture import draw_verdicts
from ds_analysis.siblings.failure_patterns import nestings
from ds_driver.whole_files import write_whole
from ds_orchestrator.maps.feature_map import slices_of
from ds_report.html_report import environment
from ds_report.page_data import data_address
from ds_sim.installation import ds_command

PAGE = "report.html"


def write_study_page(folder: Path, study: Study) -> Path:
    """Write the page into a study's folder; the same study and drives give the same bytes."""
    table = study.table()
    try:
        car = predict_car(folder, table)
        unpredicted = ""
    except OutcomeTableError as error:
        car, unpredicted = None, str(error)
    tables = []
    if study.twin is not None and car is not None:
        try:
            tables = comparison_tables(compare_predictors(table, predict_twin(table)))
        except OutcomeTableError as error:
            unpredicted = str(error)
    shown = {map_id: made for map_id, made in maps_of_study(study).items() if not map_id.operator}
    bounds = bounds_of(shown.values())
    page = environment().get_template("study.html.j2").render(
        title=folder.resolve().name,
        sentence=f"{len(table)} tests on {', '.join(study.simulators)}" if car is None else car.sentence,
        sentences=_wheres(study) + ([] if car is None else [car.prediction.kinds_sentence]),
        warning="" if car is None else span_of(car.prediction).warning,
        unpredicted=unpredicted,
        command=str(ds_command("real", "propose", folder)),
        simulators=simulator_table(study),
        pairs=pair_table(table),
        maps=[
            (part.title, data_address(draw_map(part, "probability", bounds=bounds)))
            for made in shown.values()
            for part in slices_of(made)
        ],
        verdicts="" if car is None else data_address(draw_verdicts(car.verdicts, "Predicted failures on a car")),
        tables=tables,
        features=study.features,
    )  # fmt: skip
    write_whole(folder / PAGE, page)
    return folder / PAGE


def _wheres(study: Study) -> list[str]:
    """Say for each simulator where it fails most: by the feature whose halves differ most."""
    found = []
    for name in study.simulators:
        rows = study.rows[study.rows["simulator"] == name]
        failed = rows["failed"].to_numpy(np.float64)
        best = (0.0, "", 0.0, 0.0, 0.0)
        for feature in study.features:
            values = rows[feature].to_numpy(np.float64)
            middle = float(np.median(values))
            high = values > middle
            if high.any() and not high.all():
                above, below = float(failed[high].mean()), float(failed[~high].mean())
                best = max(best, (abs(above - below), feature, middle, above, below))
        if best[1]:
            _, feature, middle, above, below = best
            found.append(
                f"{name} fails in {failed.mean():.0%} of {len(rows)} drives: {above:.0%} where {feature} is above "
                f"{middle:.3g}, {below:.0%} elsewhere."
            )
    return found


def simulator_table(study: Study) -> Table:
    """Tabulate what was read of each simulator."""
    rows = [
        (f"{name} (twin)" if name == study.twin else name, tests, drives, failed, flaky)
        for name, (tests, drives, failed, flaky) in study.flakiness().items()
    ]
    return Table(
        name="simulators",
        title="What was read",
        columns=[
            Column("simulator"), Column("tests", "count"), Column("drives", "count"), Column("failed", "number"),
            Column("tests whose repeats disagree", "number"),
        ],
        rows=rows,
    )  # fmt: skip


def pair_table(table: OutcomeTable) -> Table:
    """Tabulate how the failures of each pair of simulators lie inside each other, on the tests that both judged."""
    rows = []
    for pair in combinations(table.simulators, 2):
        both = np.all([table.known(name) for name in pair], axis=0)
        if both.any():
            (one,) = [each for each in nestings(table.select(both)) if (each.first, each.second) == pair]
            rows.append(
                (*pair, one.both, one.only_first, one.only_second, one.neither, one.second_given_first,
                 one.second_given_first_interval, one.first_given_second, one.first_given_second_interval)
            )  # fmt: skip
    names = ("both fail", "only the first", "only the second", "none")
    shares = ("second fails where the first does", "95 %", "first fails where the second does", "95 % ")
    return Table(
        name="pairs",
        title="Whose failures lie inside whose",
        columns=[
            Column("first"), Column("second"), *(Column(name, "count") for name in names),
            *(Column(name, "number") for name in shares),
        ],
        rows=rows,
    )  # fmt: skip
