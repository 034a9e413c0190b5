# SPDX-License-Identifier: Apache-2.0
"""`ds maps`: a campaign's feature maps as coloured grids in the terminal."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, verb

if TYPE_CHECKING:
    from ds_orchestrator.maps.feature_map import FeatureMap, MapCell

LONGEST_AXIS = 40
"""Bins up to which an axis shows the empty ones between its ends; chosen: a screen's height."""
app = typer.Typer()


def axes_named(text: str) -> list[str]:
    """Two or three different features in a text, separated by commas."""
    from ds_base.extension import confirm, is_extension
    from ds_orchestrator.search.features import FeatureError, base_of, feature_of

    names = [name.strip() for name in text.split(",")]
    confirm(base for base in map(base_of, names) if is_extension(base))
    if not 2 <= len({base_of(feature_of(name).name) for name in names}) == len(names) <= 3:
        raise FeatureError(f"--axes {text[:80]}: expected two or three different features, separated by commas")
    return names


def grids(feature_map: FeatureMap, width: int) -> list[Table]:
    """A map of two features as one grid, or as several side by side where it is wider than so many characters."""
    across, up = feature_map.features
    shown_cells = (*feature_map.cells, *feature_map.excluded)
    columns = _axis(cell[0] for cell in shown_cells)
    rows = _axis(cell[1] for cell in shown_cells)[::-1]
    boxes = {
        cell: _box(feature_map.cells.get(cell), feature_map.excluded.get(cell, 0))
        for cell in itertools.product(columns, rows)
    }
    head = max(len(up.title) + 2, *(len(up.label(row)) for row in rows), 1)
    widest = max([6, *map(len, boxes.values()), *(len(across.label(column)) for column in columns)])
    at_once = max(1, (width - head - 2) // (widest + 3))  # padding of a column, and the line before it
    maps = []
    for start in range(0, max(len(columns), 1), at_once):
        part = columns[start : start + at_once]
        table = Table(
            title=f"{feature_map.title}: failure probability",
            caption=f"{across.title} →",
            box=SIMPLE,
            pad_edge=False,
            padding=(0, 1),
            title_justify="left",
        )
        table.add_column(f"{up.title} ↑", justify="right", no_wrap=True)
        for column in part:
            table.add_column(across.label(column), justify="center", min_width=6, no_wrap=True)
        for row in rows:
            table.add_row(up.label(row), *(boxes[column, row] for column in part))
        maps.append(table)
    return maps


def count_line(feature_map: FeatureMap) -> Text:
    """What the numbers of a map are, and the sum of its cells."""
    cells = feature_map.cells.values()
    failing = sum(cell.probability > 0.0 for cell in cells)
    counts = any(cell.failures is not None for cell in cells)
    numbers = "Failures/tests in each cell" if counts else "Value in each cell"
    excluded = sum(feature_map.excluded.values())
    apart = f" -n: n tests of the cell are excluded by the gates and in no other number; {excluded} in all."
    filled = f"{numbers}; {failing} of {len(feature_map.cells)} filled cells have a probability above 0."
    return Text(filled + (apart if excluded else ""))


def legend() -> Text:
    """What the colours mean, on every map."""
    ramp = Text("0 ")
    for step in range(11):
        ramp.append("  ", style=_style(step / 10))
    return ramp.append(" 1  failure probability, on every map; · no test")


def _axis(bins: Iterable[int]) -> Sequence[int]:
    """The bins of an axis in order, empty ones between them included unless there are too many."""
    filled = sorted(set(bins))
    if filled and filled[-1] - filled[0] < LONGEST_AXIS:
        return range(filled[0], filled[-1] + 1)
    return filled


def _box(cell: MapCell | None, excluded: int) -> Text:
    apart = f" -{excluded}" if excluded else ""
    if cell is None:
        return Text(f"·{apart}", style="dim")
    text = f"{cell.probability:.2f}" if cell.failures is None else f"{cell.failures}/{cell.tests}"
    return Text(f"{text:^6}", style=_style(cell.probability)).append(apart, style="not bold dim")


def _style(value: float) -> str:
    """Background of a value in [0, 1], as in the pictures of the maps, and the text on it."""
    from ds_base.palette import colour_of_share, ink_on

    colour = colour_of_share(value)
    return "bold rgb({},{},{}) on rgb({},{},{})".format(*ink_on(colour), *colour)


@verb(app, "maps")
def maps_command(
    folder: options.Folder,
    name: Annotated[
        str | None, typer.Option("--map", help="Map to show; every simulator's and the merged one if left out.")
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(help="Two or three features that span the maps, separated by commas; as configured if left out."),
    ] = None,
) -> Result:
    """Show a campaign's feature maps, or those of imported outcomes, as coloured grids.

    A cell shows how often the tests of similar roads fail. There is a map for every simulator, and one of the siblings
    merged. --map shows another one alone. With --json, all of them.

    Example: ds maps out
    """
    from ds_analysis.common.outcome_table import is_study
    from ds_analysis.paper.campaign_contents import exclusion_lines, maps_of
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.campaign.folder import read_folder
    from ds_orchestrator.maps.feature_map import compared_ids, slices_of, to_json

    data = None
    if is_study(folder):
        from ds_analysis.outcomes.study import read_study
        from ds_analysis.outcomes.study_results import maps_of_study

        named = None if axes is None else [one.strip() for one in axes.split(",")]
        every = maps_of_study(read_study(folder), named)
    else:
        named = None if axes is None else axes_named(axes)
        data = read_folder(folder)
        every = maps_of(data, features=named)
    if named is not None and not any(drawn.cells or drawn.excluded for drawn in every.values()):
        raise ConfigError(
            f"no test in {folder} has a cell over {','.join(named)}: expected other --axes, or tests driven"
        )
    map_named = {map_id.name: feature_map for map_id, feature_map in every.items()}
    if name is not None and name not in map_named:
        raise ConfigError(f"{folder} has no map {name!r}: expected one of {', '.join(map_named)}")

    def show() -> None:
        console = Console()
        chosen = [map_id.name for map_id in compared_ids(every)] if name is None else [name]
        for feature_map in (map_named[one] for one in chosen):
            for part in slices_of(feature_map):
                for grid in grids(part, console.width):
                    console.print(grid)
            console.print(count_line(feature_map), highlight=False)
        console.print(legend(), highlight=False)
        for excluded in exclusion_lines(data) if data is not None else ():
            console.print(excluded, highlight=False)
        others = ", ".join(other for other in map_named if other not in chosen)
        console.print(f"Other maps, with --map NAME: {others}", highlight=False)
        if named is None and data is not None and data.config.further_axes:
            further = "; ".join(",".join(other) for other in data.config.further_axes)
            console.print(f"Other axes, with --axes A,B: {further}", highlight=False)

    return Result(document=to_json(every), show=show, next=ds_command("report", folder))
