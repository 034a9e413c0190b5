# SPDX-License-Identifier: Apache-2.0
"""Page of a comparison of two networks: one HTML file that opens offline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ds_analysis.comparison.analysis import CellComparison, Comparison, advice_of, answer_of, cautions_of, sentences_of
from ds_analysis.comparison.paired_drives import PairedDrive
from ds_analysis.comparison.tables import cell_table, command_of, drive_table, simulator_table
from ds_base.palette import FAIL, PASS, ink_on, rgb
from ds_base.table import p_in_words
from ds_report.pages import data_address, write_page
from ds_road import Road, draw
from ds_sim.registry import path_moved

PICTURED = 12
"""Drives with a picture; chosen: the page stays below a megabyte."""
_SIZE = 400
STRONG = 0.5
"""Difference from which a cell's text no longer has the page's colour; chosen: half of the way to `FAIL` or `PASS`."""


@dataclass(frozen=True, kw_only=True)
class GridCell:
    """Cell of a difference map on the page; an empty text is a cell without tests."""

    text: str = ""
    title: str = ""
    style: str = ""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Difference map of one simulator: labels, and for each row, the largest first, its label and cells."""

    title: str
    across: str
    up: str
    columns: Sequence[str]
    rows: Sequence[tuple[str, Sequence[GridCell]]]


def write_comparison_page(
    comparison: Comparison, path: Path, road_files: Mapping[str, str], unmet: Sequence[str] = ()
) -> None:
    """Write the page; the same comparison gives the same bytes.

    `road_files` has the file with the road of tests that newly fail; `unmet` the pass criteria that are not met.
    """
    worse = comparison.newly_failing
    write_page(
        path,
        "comparison.html.j2",
        comparison=comparison,
        advice=advice_of(comparison),
        answer=answer_of(comparison),
        sentences=sentences_of(comparison),
        cautions=cautions_of(comparison),
        unmet=unmet,
        grids=grids_of(comparison),
        simulators=simulator_table(comparison),
        cells=cell_table(comparison),
        drives=drive_table(comparison),
        pictures=[
            (one, _picture(one, one.test.scenario.road), _command(one, comparison, road_files, path.parent))
            for one in worse[:PICTURED]
            if one.test.scenario is not None
        ],
        more=len(worse) - PICTURED if worse and worse[0].test.scenario else len(worse),
    )


def grids_of(comparison: Comparison) -> list[Grid]:
    """Difference maps, one for each simulator, and of three features one for each bin of the third."""
    across, up, *third = comparison.features
    groups: dict[tuple[str, tuple[int, ...]], dict[tuple[int, ...], CellComparison]] = {}
    for one in comparison.cells:
        groups.setdefault((one.simulator, one.cell[2:]), {})[one.cell[:2]] = one
    # The same axes for all, so that grids compare cell by cell.
    columns = sorted({one.cell[0] for one in comparison.cells})
    rows = sorted({one.cell[1] for one in comparison.cells}, reverse=True)
    return [
        Grid(
            title=", ".join([name, *(f"{f.title} {f.label(b)}" for f, b in zip(third, rest, strict=True))]),
            across=across.title,
            up=up.title,
            columns=[across.label(column) for column in columns],
            rows=[(up.label(row), [_grid_cell(cells.get((column, row))) for column in columns]) for row in rows],
        )
        for (name, rest), cells in groups.items()
    ]


def style_of_difference(difference: float) -> str:
    """CSS of a difference in [-1, 1]: `PASS` where tests are fixed, `FAIL` where they newly fail."""
    colour = rgb(FAIL if difference > 0 else PASS)
    style = "background: rgb({} {} {} / {:.0%})".format(*colour, min(abs(difference), 1.0))
    return style + "; color: rgb({} {} {})".format(*ink_on(colour)) * (abs(difference) > STRONG)


def _grid_cell(one: CellComparison | None) -> GridCell:
    if one is None:
        return GridCell()
    counts = one.counts
    assert counts.difference is not None and counts.interval is not None
    changes = [f"+{counts.newly_fail}"] * bool(counts.newly_fail) + [f"−{counts.fixed}"] * bool(counts.fixed)
    low, high = counts.interval
    return GridCell(
        text=f"{' '.join(changes) or '0'}/{counts.tests}",
        title=f"{counts.newly_fail} newly fail, {counts.fixed} fixed, {counts.both_fail} fail in both, of "
        f"{counts.tests}; difference {counts.difference:+.2f}, 95%: {low:+.2f} to {high:+.2f}; "
        f"{p_in_words(one.p_adjusted)} after Benjamini and Hochberg",
        style=style_of_difference(counts.difference),
    )


def _picture(drive: PairedDrive, road: Road) -> str:
    """Address of a picture of the road with the paths that are known."""
    paths = {"reference": drive.reference.path, "candidate": drive.candidate.path}
    driven = {name: path for name, path in paths.items() if len(path)}
    return data_address(draw(road, trajectories=driven, size=_SIZE, caption=False))


def _command(drive: PairedDrive, comparison: Comparison, road_files: Mapping[str, str], folder: Path) -> str:
    """The command that drives a test again, as typed in the page's folder, so that the folder can be moved."""
    file = road_files.get(drive.test.name)
    if not file:
        return ""
    here = Path()
    simulator = drive.simulator.moved(here, folder)
    driver = comparison.candidate.driver.moved(here, folder)
    return command_of(replace(drive, simulator=simulator), driver, path_moved(file, here, folder))
