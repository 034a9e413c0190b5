# SPDX-License-Identifier: Apache-2.0
"""Pass criteria, and the files and tables of a comparison."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ds_base.palette import FAIL, PASS
from ds_cli.output import Result

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import Comparison
    from ds_analysis.comparison.ci_results import Criteria
    from ds_report.comparison_page import Grid


def criteria_of(fail_on: str | None, max_failures: str | None, *, has_reference: bool) -> Criteria:
    """The pass criteria that the options describe, if they make sense."""
    from ds_analysis.comparison.ci_results import Criteria, MaxFailures

    limit = None if max_failures is None else MaxFailures.parse(max_failures)
    criteria = Criteria(fail_on=fail_on, max_failures=limit)  # type: ignore[arg-type]
    criteria.check(has_reference=has_reference)
    return criteria


def check_writable(*paths: Path | None) -> None:
    """Refuse files that could not be written at the end, before anything is driven."""
    for path in paths:
        if path is not None and path.is_dir():
            raise IsADirectoryError(21, "is a folder, expected a file to write", str(path))
        if path is not None and not path.absolute().parent.is_dir():
            raise FileNotFoundError(2, "there is no such folder: create it first", str(path.absolute().parent))


MOST_COLUMNS = 14
"""Columns of a grid; chosen: they fit on a line of 120 characters."""


def write_comparison(
    comparison: Comparison, out: Path, criteria: Criteria, following: str, *, junit: Path | None, markdown: Path | None
) -> Result:
    """Write comparison.json, .md and .html, tables, the roads of tests that newly fail, and what a CI job shows.

    `following` is what a user types next where no test newly fails.
    """
    from ds_analysis.comparison import tables
    from ds_analysis.comparison.analysis import answer_of, cautions_of, sentences_of
    from ds_analysis.comparison.ci_results import cases_of, junit_of
    from ds_base.atomic_files import write_json, write_whole
    from ds_base.installation import as_typed
    from ds_base.table import write_tables
    from ds_report.comparison_page import grids_of, write_comparison_page

    worse = [row.simulator for row in comparison.simulators if row.verdict == "worse"]
    unmet = criteria.unmet(comparison.tally(), newly_failing=len(comparison.newly_failing), worse=worse)
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
    if junit is not None:
        name = f"{comparison.candidate.driver} against {comparison.reference.driver}"
        write_whole(junit, junit_of(name, cases_of(comparison)))
    if markdown is not None:
        write_whole(markdown, tables.markdown_of(comparison, road_files, unmet))

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
    from ds_base.atomic_files import write_whole
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
