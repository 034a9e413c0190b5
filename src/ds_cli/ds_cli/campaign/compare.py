# SPDX-License-Identifier: Apache-2.0
"""`ds compare`: what a network does better or worse than another, and where."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ds_base.folder_files import make_folder, write_json, write_whole
from ds_base.installation import as_typed, ds_command
from ds_base.palette import FAIL, PASS
from ds_cli import options
from ds_cli.campaign.run import SIMULATORS
from ds_cli.output import Result, stopped_in, verb
from ds_sim.registry import SimulatorName

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import Comparison, Origin
    from ds_analysis.comparison.paired_drives import Network
    from ds_driver.networks.driver_name import DriverName
    from ds_orchestrator.campaign.folder import CampaignData
    from ds_report.comparison_page import Grid
    from ds_studies.comparison import GivenTests

ROADS, SEED = 40, 40
"""Random roads of two networks, and their seed; chosen: those of `ds siblings compare`."""
TWIN = SimulatorName("donkey")
"""Simulator that acts as the twin of two networks' random roads, if it is among others."""

app = typer.Typer()


Task = tuple[list["GivenTests"], tuple["Network", "Network"], "Origin", str]
"""Tests, reference and candidate, how the tests were chosen, and where they come from, in words."""


def _of_campaign_and_network(campaign: Path, network: DriverName, trust: Sequence[str]) -> Task:
    """The tests of a campaign, to be driven with a network."""
    from ds_studies.comparison import network_of_campaign, tests_of_campaign

    data = _trusted(campaign, trust)
    tests = tests_of_campaign(campaign, data)
    networks = network_of_campaign(data), network_named(network, tests.settings.simulators)
    source = f"The tests of the campaign {campaign}, {tests.pairs} drives of each network"
    return [tests], networks, _origin(data, "reference"), source


def _of_campaigns(reference: Path, candidate: Path, trust: Sequence[str]) -> Task:
    """The tests of two campaigns of one configuration, each of whose networks drives the other's tests, too."""
    from ds_studies.comparison import network_of_campaign, tests_of_campaigns

    first, second = (_trusted(folder, trust) for folder in (reference, candidate))
    sets = tests_of_campaigns((reference, first), (candidate, second))
    pairs = sum(tests.pairs for tests in sets)
    source = f"The tests of the campaigns {reference} (r-...) and {candidate} (c-...), {pairs} drives of each network"
    return sets, (network_of_campaign(first), network_of_campaign(second)), _origin(first, "both"), source


def _of_networks(
    reference: DriverName, candidate: DriverName, simulators: Sequence[SimulatorName], roads: int, seed: int
) -> Task:
    """Random roads for two networks."""
    from ds_driver.data.collection import unseen_roads
    from ds_studies.comparison import random_tests

    twin = TWIN if TWIN in simulators and len(simulators) > 1 else None
    siblings = [name for name in simulators if name != twin]
    tests = random_tests(unseen_roads(roads, seed), seed, siblings=siblings, twin=twin)
    networks = network_named(reference, simulators), network_named(candidate, simulators)
    return [tests], networks, "random", f"{roads} random roads of seed {seed} on {', '.join(simulators)}"


def is_campaign(text: str) -> bool:
    """Whether an argument is a folder, and so a campaign; otherwise it names a network."""
    return Path(text).is_dir()


def _trusted(folder: Path, trust: Sequence[str]) -> CampaignData:
    """Read a campaign; the code that it names is shipped or trusted."""
    from ds_orchestrator.campaign.folder import read_folder
    from ds_studies.whole_campaign import check_trust

    data = read_folder(folder)
    check_trust(data.config, trust)
    return data


def _origin(data: CampaignData, searched: Origin) -> Origin:
    return "random" if data.config.search.method == "random" else searched


def network_named(driver: DriverName, simulators: Sequence[SimulatorName]) -> Network:
    """A network with its digest, checked before anything starts."""
    from ds_analysis.comparison.paired_drives import Network
    from ds_driver.networks.network_driver import driver_sha256
    from ds_orchestrator.engines.start import check_driver

    check_driver(driver, simulators)
    return Network(driver=driver, sha256=driver_sha256(driver))


MOST_COLUMNS = 14
"""Columns of a grid; chosen: they fit on a line of 120 characters."""


def write_comparison(comparison: Comparison, out: Path, passing: options.ComparisonCriteria, following: str) -> Result:
    """Write comparison.json, .md and .html, tables, the roads of tests that newly fail, and what a CI job shows.

    `following` is what a user types next where no test newly fails.
    """
    from ds_analysis.comparison import tables
    from ds_analysis.comparison.analysis import answer_of, cautions_of, sentences_of
    from ds_analysis.comparison.ci_results import cases_of, junit_of
    from ds_base.table import write_tables
    from ds_report.comparison_page import grids_of, write_comparison_page

    worse = [row.simulator for row in comparison.simulators if row.verdict == "worse"]
    unmet = passing.criteria.unmet(comparison.tally(), newly_failing=len(comparison.newly_failing), worse=worse)
    road_files = write_roads(comparison, out / "worse")
    document = {
        "version": 1,
        **tables.document_of(comparison, road_files),
        "unmet": unmet,
        "page": str(out / "comparison.html"),
    }
    write_json(out / "comparison.json", document)
    write_whole(out / "comparison.md", tables.markdown_of(comparison, road_files, unmet))
    write_tables(
        [tables.simulator_table(comparison), tables.cell_table(comparison), tables.drive_table(comparison)],
        out / "tables",
    )
    write_comparison_page(comparison, out / "comparison.html", road_files, unmet)
    if passing.junit is not None:
        name = f"{comparison.candidate.driver} against {comparison.reference.driver}"
        write_whole(passing.junit, junit_of(name, cases_of(comparison)))
    if passing.markdown is not None:
        write_whole(passing.markdown, tables.markdown_of(comparison, road_files, unmet))

    def show() -> None:
        console = Console()
        tables.simulator_table(comparison).show(console)
        grids = [grid for grid in grids_of(comparison) if len(grid.columns) <= MOST_COLUMNS]
        cells = tables.cell_table(comparison, most=tables.MOST_ROWS)
        for grid in grids:
            print(f"{grid.title}: tests that newly fail (+) and that are fixed (−), of all")
            console.print(_difference_grid(grid))
        if grids:
            print(cells.notes[0])
        elif cells.rows:
            cells.show(console)
        drives = tables.drive_table(comparison, most=tables.MOST_ROWS)
        if drives.rows:
            drives.show(console)
        for command in again[: tables.MOST_ROWS]:
            print(as_typed(command))
        for line in (*sentences_of(comparison), *cautions_of(comparison)):
            print(line)
        print(answer_of(comparison))
        print(out / "comparison.html")

    again = [
        tables.command_of(drive, comparison.candidate.driver, road_files[drive.test.name])
        for drive in comparison.newly_failing
        if drive.test.name in road_files
    ]
    return Result(
        document=document, show=show, error=bool(comparison.left_out), unmet=unmet, next=[*again, following][0]
    )


def write_roads(comparison: Comparison, folder: Path) -> dict[str, str]:
    """Write a road file for every test that newly fails, as `ds drive --road` takes it; test -> file."""
    from ds_road.files import road_object
    from ds_sim.conditions.text import format_conditions

    files = {}
    for drive in comparison.newly_failing:
        scenario = drive.test.scenario
        if scenario is None:
            continue
        path = folder / f"{drive.test.name}.json"
        entry = road_object(scenario.road) | {"seed": scenario.seed}
        if conditions := format_conditions(scenario.conditions):
            entry["conditions"] = conditions
        write_whole(path, json.dumps([entry], allow_nan=False) + "\n")
        files[drive.test.name] = str(path)
    return files


def _difference_grid(grid: Grid) -> Table:
    """A map of differences for a terminal: `FAIL` where tests newly fail, `PASS` where they are fixed."""
    table = Table(caption=f"{grid.across} →", box=SIMPLE, pad_edge=False, padding=(0, 1))
    table.add_column(f"{grid.up} ↑", justify="right", no_wrap=True)
    for label in grid.columns:
        table.add_column(label, justify="center", min_width=7, no_wrap=True)
    for label, cells in grid.rows:
        styles = {"+": f"bold {FAIL}", "−": f"bold {PASS}", "": "dim"}
        table.add_row(label, *(Text(cell.text or "·", style=styles.get(cell.text[:1], "")) for cell in cells))
    return table


@verb(app, "compare")
def campaign_compare_command(
    first: Annotated[str, typer.Argument(metavar="A", help="Reference: a campaign or study, or a network.")],
    second: Annotated[
        str | None, typer.Argument(metavar="B", help="Candidate: a campaign folder, or a network.")
    ] = None,
    driver: Annotated[str | None, typer.Option(help="Candidate, a network; the same as B.")] = None,
    backend: options.Backend = "auto",
    out: Annotated[
        Path, typer.Option(help="Folder for drives and results; a comparison that was stopped there is resumed.")
    ] = Path("comparison"),
    roads: Annotated[
        int | None, typer.Option(min=1, max=10_000, help=f"For two networks: random roads; {ROADS} if left out.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**32 - 1, help=f"For two networks: seed; {SEED} if left out.")
    ] = None,
    sims: Annotated[
        str | None, typer.Option(help=f"For two networks: simulators, by commas; {SIMULATORS} if left out.")
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Drive the reference again, too, instead of reading its outcomes.")
    ] = False,
    stop_early: Annotated[
        bool, typer.Option("--stop-early", help="For two networks: end as soon as the answer is sure.")
    ] = False,
    *,
    passing: options.ComparisonCriteria,
    driving: options.DrivingAnywhere,
    trust: options.Trust = None,
) -> Result:
    """Compare two networks on the same tests: what got worse, what got better?

    A and B are two networks, which drive random roads; a campaign and a network, which drives the tests of the
    campaign; two campaigns of one configuration; or two studies of imported outcomes. Drives that are missing come
    first, without ROS unless --engine says otherwise. Writes comparison.html, comparison.md and comparison.json under
    --out.

    Example: ds compare old.yaml new.yaml --out comparison
    """
    from ds_analysis.common.outcome_table import is_study
    from ds_analysis.comparison.paired_drives import ComparisonError
    from ds_analysis.outcomes.study_results import compare_studies
    from ds_cli.progress import ScreenListener
    from ds_orchestrator.engines.drive_tests import Callbacks
    from ds_studies.comparison import compare, compare_until_sure

    if (second is None) == (driver is None):
        raise ComparisonError("expected one candidate, as in `ds compare A B` or `ds compare A --driver B`")
    candidate = second or str(driver)
    passing.check(passing.markdown)
    only_networks = {
        "--roads": roads is not None,
        "--seed": seed is not None,
        "--sims": sims,
        "--stop-early": stop_early,
    }
    of_networks_alone = [name for name, is_set in only_networks.items() if is_set]

    def task() -> Task:
        if is_campaign(first) and of_networks_alone:
            raise ComparisonError(f"{of_networks_alone[0]} is for two networks: {first} has its own tests")
        if is_campaign(first) and is_campaign(candidate):
            return _of_campaigns(Path(first), Path(candidate), trust or [])
        if is_campaign(candidate):
            raise ComparisonError(f"{first} is no campaign folder: give the campaign first, then the network")
        network = options.driver_named(candidate, backend)
        if is_campaign(first):
            return _of_campaign_and_network(Path(first), network, trust or [])
        names = options.simulators_of(sims or SIMULATORS, default=sims is None)
        return _of_networks(options.driver_named(first), network, names, roads or ROADS, SEED if seed is None else seed)

    if is_study(Path(first)) and is_study(Path(candidate)):
        comparison = compare_studies(Path(first), Path(candidate))
        make_folder(out)
    else:
        sets, networks, origin, source = task()
        for k, tests in enumerate(sets):
            settings = replace(tests.settings, **driving.without_ros())
            sets[k] = replace(tests, settings=settings, reference={} if again else tests.reference)
        make_folder(out)
        callbacks = Callbacks(listen=ScreenListener)
        with stopped_in(out):
            if stop_early:
                comparison = compare_until_sure(sets[0], *networks, source=source, out=out, callbacks=callbacks)
            else:
                comparison = compare(sets, *networks, origin=origin, source=source, out=out, callbacks=callbacks)
    following = ds_command("report" if is_campaign(candidate) else "test", candidate)
    return write_comparison(comparison, out, passing, following)
