"""`ds road`: roads to generate, check and look at."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

import ds_road
from ds_orchestrator.cli.options import JsonFlag, MaxAngle, Seed
from ds_orchestrator.cli.output import Result, answer
from ds_sim.camera.png import png

app = typer.Typer()
road_app = typer.Typer(help="Roads: generate, check, show.", no_args_is_help=True)
app.add_typer(road_app, name="road")


def generate_roads(seed: int, count: int, max_angle: int) -> list[Any]:
    """Control points of random roads."""
    rng = np.random.default_rng(seed)
    return [ds_road.generate(rng, max_angle=max_angle).control_points for _ in range(count)]


def check_roads(file: Path) -> Result:
    """Validity and features of every road of a file."""
    document = [ds_road.check(raw) for raw in ds_road.read_raw_roads(file)]

    def show() -> None:
        table = Table("road", "valid", "length m", "curvature /m", "turns", "turns as maxitwo_compatible", "reason")
        for index, row in enumerate(document):
            known = row["length"] is not None
            table.add_row(
                str(index),
                "yes" if row["valid"] else "no",
                f"{row['length']:.1f}" if known else "",
                f"{row['curvature']:.4f}" if known else "",
                str(row["turns_count"]) if known else "",
                str(row["turns_count_maxitwo"]) if known else "",
                row["reason"],
            )
        Console().print(table)

    return Result(document=document, show=show)


def show_road(file: Path | None, seed: int, max_angle: int, out: Path) -> Path:
    """Draw one road as a PNG."""
    out.write_bytes(png(ds_road.draw(one_road(file, seed, max_angle))))
    return out


def one_road(file: Path | None, seed: int, max_angle: int) -> ds_road.Road:
    """The road of a file that holds just one, or a random one."""
    if file is None:
        return ds_road.generate(np.random.default_rng(seed), max_angle=max_angle)
    roads = ds_road.read_roads(file)
    if len(roads) != 1:
        raise ds_road.RoadError(f"{file}: {len(roads)} roads, expected one")
    return roads[0]


@road_app.command("generate")
def road_generate_command(
    seed: Seed = 0,
    count: Annotated[int, typer.Option(min=1, max=100_000, help="How many.")] = 1,
    max_angle: MaxAngle = 270,
) -> None:
    """Random roads as a JSON list on standard output."""
    print(json.dumps(generate_roads(seed, count, max_angle)))


@road_app.command("check")
def road_check_command(
    file: Annotated[Path, typer.Argument(help="JSON list of roads.")], as_json: JsonFlag = False
) -> None:
    """Validity and features of every road of a file."""
    answer(check_roads(file), as_json)


@road_app.command("show")
def roadshow_command(
    file: Annotated[Path | None, typer.Argument(help="File with one road as JSON.")] = None,
    seed: Seed = 0,
    max_angle: MaxAngle = 270,
    out: Annotated[Path, typer.Option(help="PNG to write.")] = Path("road.png"),
) -> None:
    """Draw a road."""
    print(show_road(file, seed, max_angle, out))
