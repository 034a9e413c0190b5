"""Writes and shows a comparison: page, Markdown, JSON, tables, and the roads of tests that newly fail."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from ds_cli.campaign.pass_options import write_reports
from ds_cli.output import Result

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import Comparison


def write_comparison(
    found: Comparison, out: Path, unmet: Sequence[str], *, junit: Path | None, markdown: Path | None
) -> Result:
    """Write comparison.json, .md and .html, tables and the roads of tests that newly fail."""
    from ds_analysis.common.table import write_tables
    from ds_analysis.comparison.markdown import markdown_of
    from ds_analysis.comparison.summary import answer_of, cautions_of, sentences_of
    from ds_analysis.comparison.tables import (
        MOST_ROWS,
        cell_table,
        command_of,
        document_of,
        drive_table,
        simulator_table,
    )
    from ds_report.comparison_page import write_comparison_page

    road_files = write_roads(found, out / "worse")
    document = {**document_of(found, road_files), "unmet": list(unmet), "page": str(out / "comparison.html")}
    (out / "comparison.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", "utf-8")
    (out / "comparison.md").write_text(markdown_of(found, road_files, unmet), "utf-8")
    write_tables([simulator_table(found), cell_table(found), drive_table(found)], out / "tables")
    write_comparison_page(found, out / "comparison.html", road_files, unmet)
    write_reports(found, road_files, unmet, junit=junit, markdown=markdown)

    def show() -> None:
        from ds_cli.campaign.difference_grid import difference_grids

        console = Console()
        simulator_table(found).show(console)
        grids, cells = difference_grids(found), cell_table(found, most=MOST_ROWS)
        for heading, grid in grids:
            print(heading)
            console.print(grid)
        if grids:
            print(cells.notes[0])
        elif cells.rows:
            cells.show(console)
        worse = drive_table(found, most=MOST_ROWS)
        if worse.rows:
            worse.show(console)
        for drive in found.newly_failing[:MOST_ROWS]:
            print(command_of(drive, found.candidate.driver, road_files[drive.test.name]))
        for line in (*sentences_of(found), *cautions_of(found)):
            print(line)
        print(answer_of(found))
        print(out / "comparison.html")

    return Result(document=document, show=show, error=bool(found.left_out), unmet=unmet)


def write_roads(found: Comparison, folder: Path) -> dict[str, str]:
    """Write a road file for every test that newly fails, as `ds drive --road` takes it; test -> file."""
    from ds_road import road_to_json
    from ds_sim.conditions.text import format_conditions

    files = {}
    for drive in found.newly_failing:
        test = drive.test
        folder.mkdir(exist_ok=True)
        path = folder / f"{test.name}.json"
        road = road_to_json(test.road)
        entry = {**(road if isinstance(road, dict) else {"control_points": road}), "seed": test.seed}
        entry |= {} if test.conditions.is_default else {"conditions": format_conditions(test.conditions)}
        path.write_text(json.dumps([entry], allow_nan=False) + "\n", "utf-8")
        files[test.name] = str(path)
    return files
