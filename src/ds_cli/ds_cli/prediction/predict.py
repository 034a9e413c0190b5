# SPDX-License-Identifier: Apache-2.0
"""`ds predict`, `ds evaluate`: where the car fails, and how well such predictions do on a driven twin."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from ds_base.folder_files import locked, make_folder, write_json, write_whole
from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, verb
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from ds_analysis.common.outcome_table import OutcomeTable
    from ds_base.table import Table
    from ds_driver.networks.driver_name import DriverName

app = typer.Typer()

TestsFolder = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder of a campaign, `ds siblings compare` or `ds outcomes import`.")
]
Tolerated = Annotated[float, typer.Option(min=0.001, max=0.999, help="Failure rate up to which a cell counts as safe.")]
MOST_SHOWN = 10
"""Rows of the table that is always shown."""


def without_prediction(folder: Path, table: OutcomeTable, reason: str) -> Result:
    """Say how many tests each simulator fails, if there are too few for a prediction."""
    from ds_base.intervals import jeffreys_interval

    counts = {name: (int(table.failed(name).sum()), int(table.known(name).sum())) for name in table.simulators}
    intervals = {name: jeffreys_interval(*count) if count[1] else (0.0, 1.0) for name, count in counts.items()}

    def show() -> None:
        print(f"no prediction: {reason}")
        for name, (failures, tests) in counts.items():
            low, high = intervals[name]
            print(f"{name} fails {failures} of {tests} tests (95% of its failure rate: {low:.0%} to {high:.0%})")

    rows = {
        name: {"tests": tests, "failures": failures, "interval": list(intervals[name])}
        for name, (failures, tests) in counts.items()
        if tests
    }
    document = {"verdicts": None, "reason": reason, "simulators": rows}
    return Result(document=document, show=show, next=ds_command("maps", folder))


@verb(app, "predict")
def predict_command(
    folder: TestsFolder,
    twin: Annotated[
        SimulatorName | None,
        options.simulator_option(
            "Simulator that plays the twin; others play the siblings. If left out, the twin of the campaign."
        ),
    ] = None,
    tolerated: Tolerated = 0.1,
    every_table: Annotated[bool, typer.Option("--tables", help="Show every cell, and how predictors did.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for prediction.json, verdicts.png and tables.")] = None,
) -> Result:
    """Predict where a car, or a simulator that was never driven, fails.

    The prediction for a car uses the drives on every simulator, the twin among them, and the recorded drives of the
    car. `--twin` predicts a simulator as if it had never been driven. Each cell fails, is safe, or is disputed.
    docs/merge.md says how.

    Example: ds predict out
    """
    from dataclasses import replace

    from ds_analysis.common.outcome_table import MOST_ANALYSED, OutcomeTableError
    from ds_analysis.outcomes.reading import read_table
    from ds_analysis.prediction.car import predict_car
    from ds_analysis.prediction.mixture import predict, too_few
    from ds_analysis.prediction.predictors import compare_predictors, comparison_tables
    from ds_analysis.prediction.verdicts import cell_table, judge
    from ds_base.table import write_tables
    from ds_report.heatmap import draw_verdicts
    from ds_sim.camera.encodings import png

    table = read_table(folder, twin=twin, most=MOST_ANALYSED)
    if reason := too_few(table if twin else table.as_population()):
        return without_prediction(folder, table, reason)
    if out is not None:
        make_folder(out)
    document: dict[str, Any] = {}
    if twin is None:
        say(f"{len(table)} tests on {', '.join(table.as_population().siblings)}: predicting a car")
        car = predict_car(folder, table, tolerated=tolerated)
        verdicts, title, said = car.verdicts, "Predicted failures on a car", car.help.sentence
        sentence, document = car.sentence, car.document()
        drives = "" if said else "Nobody knows yet whether these simulators know your car; a few drives tell."
        following = ds_command("real", "propose", folder, "--drives", 6)
        alone = predict(table) if table.twin else car.undriven
    else:
        say(f"{len(table)} tests on {', '.join(table.siblings)}: predicting {twin} as if it had never been driven")
        alone = predict(table)
        verdicts = judge(table, alone, tolerated=tolerated)
        expected = sum(one.probability for one in verdicts.tests)
        title, said, drives = f"Predicted failures on {twin}, never driven", "", ""
        sentence = f"On {twin}, never driven, {expected:.0f} of {len(verdicts.tests)} tests are expected to fail."
        document = {"sentence": sentence, "siblings": list(table.siblings), "verdicts": verdicts.document()}
        following = ds_command("predict", folder, "--twin", twin, "--tables")
    cells = cell_table(verdicts)
    tables, missing = [cells], ""
    document |= {"twin": table.twin, "tests_left_out": table.left_out, "comparison": None}
    try:
        comparison = compare_predictors(table, alone)
    except OutcomeTableError as error:
        if twin is not None:
            raise
        document["no_comparison"] = missing = str(error)
    else:
        tables += comparison_tables(comparison)
        document["comparison"] = comparison.document()
    if out is not None:
        write_tables(tables, out)
        write_json(out / "prediction.json", document)
        if any(one.tests for one in verdicts.cells):
            write_whole(out / "verdicts.png", png(draw_verdicts(verdicts, title)))

    def show() -> None:
        console = Console()
        print(sentence)
        if every_table:
            for one in tables:
                one.show(console)
            if missing:
                print(f"predictors are not compared: {missing}")
        else:
            rate = [column.name for column in cells.columns].index("failure rate")
            rows = sorted(cells.rows, key=lambda row: -float(str(row[rate])))[:MOST_SHOWN]
            titled = f"The {len(rows)} of {len(cells.rows)} cells with the highest predicted failure rates"
            replace(cells, rows=rows, title=titled).show(console)
        written = str(out / "prediction.json") if out else ""
        for line in (said, drives, table.sample_note, written):
            if line:
                print(line)

    return Result(document=document, show=show, next=following)


def _offline_tables(
    data: Path,
    driver: DriverName,
    siblings: list[SimulatorName] | None,
    twin: SimulatorName,
    images: int | None,
    trusted: Collection[str],
) -> list[Table]:
    from ds_analysis.paper.open_loop import OpenLoopError, predict
    from ds_analysis.paper.paper_tables import error_tables, network_of
    from ds_analysis.paper.steering_error_stats import check_error_robustness, compare_errors

    answers = predict(data, driver, ScreenProgress(), images=images, trusted=trusted)
    names = siblings if siblings is not None else [name for name in answers if name != twin]
    missing = [name for name in (*names, twin) if name not in answers]
    if missing:
        raise OpenLoopError(f"{data} has no images of {', '.join(missing)}: it has those of {', '.join(answers)}")
    errors = {name: answers[name].absolute_errors for name in (*names, twin)}
    of_siblings = {name: errors[name] for name in names}
    compared, other_ways = compare_errors(of_siblings, errors[twin]), check_error_robustness(of_siblings, errors[twin])
    return error_tables(compared, other_ways, errors, names, twin, network_of(driver))


def is_detail(table: Table) -> bool:
    """True for a table that checks another one or lists what a figure shows: printed with --all only."""
    return any(word in table.name for word in ("robustness", "variants", "densities", "sibling_"))


def tables_result(tables: list[Table], out: Path | None, following: str, *, everything: bool) -> Result:
    """Write tables to a folder, and print the main ones, or everything; `following` is what a user types next."""
    from ds_base.table import write_tables

    if out is not None:
        write_tables(tables, out)

    def show() -> None:
        console = Console()
        for table in tables:
            if everything or not is_detail(table):
                table.show(console)
        hidden = [table.title for table in tables if is_detail(table)]
        if hidden and not everything:
            print(f"Not shown without --all: {'; '.join(hidden)}")
        if out is not None:
            print(f"{out}: every table as CSV and LaTeX")

    return Result(document={one.name: one.document() for one in tables}, show=show, next=following)


@verb(app, "evaluate")
def evaluate_command(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[DIR]", help="Campaign. Without one, --driver is compared on --data alone."),
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Data set of `ds collect`, for RQ1.")] = None,
    driver: Annotated[
        str | None, typer.Option(help="Without DIR: shipped network or weights file; dave2 if left out.")
    ] = None,
    siblings: Annotated[
        str | None, typer.Option(help="Without DIR: simulators, separated by commas; all but the twin if left out.")
    ] = None,
    twin: Annotated[
        SimulatorName | None, options.simulator_option("Without DIR: simulator that acts as the twin; else donkey.")
    ] = None,
    images: Annotated[int | None, typer.Option(min=1, help="Images of each simulator at most.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for CSV and LaTeX; DIR/evaluation if left out.")] = None,
    everything: Annotated[bool, typer.Option("--all", help="Print the robustness checks and densities too.")] = False,
    trust: options.Trust = None,
) -> Result:
    """Compute how well the siblings predict the twin (RQ2, RQ3; RQ1 with data).

    The tables of the paper show its numbers next to those of your campaign. With --data and no campaign, you get RQ1 of
    any network: its steering errors on the images of the siblings and of the twin, without driving. With --json, CSV
    and LaTeX, all tables.

    Example: ds evaluate out
    """
    trusted = trust or []
    if folder is None:
        if data is None:
            raise typer.BadParameter("nothing to evaluate: name a campaign's folder, or a data set with --data")
        names = None if siblings is None else [SimulatorName(name) for name in siblings.split(",")]
        network = options.driver_named(driver or "dave2")
        tables = _offline_tables(data, network, names, twin or SimulatorName("donkey"), images, trusted)
        return tables_result(tables, out, ds_command("test", network), everything=everything)
    if of_campaign := [name for name, value in (("driver", driver), ("siblings", siblings), ("twin", twin)) if value]:
        raise typer.BadParameter(f"--{of_campaign[0]} is the campaign's: leave it out, or leave out {folder}")
    from ds_analysis.paper.campaign_contents import maps_of
    from ds_analysis.paper.open_loop import OpenLoopError
    from ds_analysis.paper.paper_tables import evaluate_campaign
    from ds_base.table import keep_tables
    from ds_driver.networks.driver_name import received_driver
    from ds_orchestrator.campaign.folder import read_folder
    from ds_report.build import RQ1
    from ds_report.sections import sibling_section

    if out is not None:
        make_folder(out)
    with locked(folder) if out is None or data is not None else nullcontext():
        campaign = read_folder(folder)
        config, maps = campaign.config, maps_of(campaign)
        if config.twin is None:
            raise OpenLoopError(f"the campaign in {folder} has no twin, so there is nothing to compare its maps with")
        tables = []
        if data is not None:
            received_driver(config.driver, confirmed=trusted)
            tables += _offline_tables(data, config.driver, config.siblings, config.twin, images, trusted)
            keep_tables(tables, folder / RQ1)
        tables += evaluate_campaign(config, maps)[-1]
        tables += section.tables if (section := sibling_section(campaign)) else []
        following = ds_command("report", folder)
        return tables_result(tables, out or folder / "evaluation", following, everything=everything)
