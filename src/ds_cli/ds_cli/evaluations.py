# SPDX-License-Identifier: Apache-2.0
"""`ds evaluate`: how well the siblings predict the twin, in the paper's tables."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, verb
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from ds_base.table import Table
    from ds_driver.networks.driver_name import DriverName

app = typer.Typer()


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
    from ds_base.folder_files import locked, make_folder
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
        tables += evaluate_campaign(config, maps).tables
        tables += section.tables if (section := sibling_section(campaign)) else []
        following = ds_command("report", folder)
        return tables_result(tables, out or folder / "evaluation", following, everything=everything)
