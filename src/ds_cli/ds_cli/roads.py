# SPDX-License-Identifier: Apache-2.0
"""`ds road`: generate, check, draw, export, import and cut roads."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, printed_to, say, say_next, verb

if TYPE_CHECKING:
    from ds_road import Road, Side

road_app = typer.Typer()


def roads_of(
    file: Path | None, lane: Side | None, *, count: int = 1, seed: int = 0, max_angle: int = 270
) -> list[Road]:
    """The roads of a file, or random ones, in a lane if one is given; each can be driven."""
    import ds_road
    from ds_driver.data.collection import unseen_roads

    roads = unseen_roads(count, seed, max_angle=max_angle) if file is None else ds_road.read_roads(file)
    if not roads:
        raise ds_road.RoadError(f"{file}: no roads, expected at least one")
    roads = [road if lane is None else road.in_lane(lane) for road in roads]
    for index, road in enumerate(roads):
        if not road.validity.valid:
            raise ds_road.RoadError(f"road {index} is not valid: {road.validity.reason}: leave it out")
    return roads


def one_road(
    file: Path | None, seed: int, max_angle: int, lane: Side | None = None, *, own: Road | None = None
) -> Road:
    """The road of a file that holds one, or a random one; `own` takes the place of a random one."""
    import numpy as np

    import ds_road

    if file is None and own is not None:
        return own if lane is None else own.in_lane(lane)
    if file is None:
        return ds_road.generate(np.random.default_rng(seed), max_angle=max_angle, lane=lane or "right")
    roads = ds_road.read_roads(file)
    if len(roads) != 1:
        raise ds_road.RoadError(f"{file}: {len(roads)} roads, expected one: keep the one to drive")
    return roads[0] if lane is None else roads[0].in_lane(lane)


@road_app.command("generate")
def road_generate_command(
    seed: options.Seed = 0,
    count: Annotated[int, typer.Option(min=1, max=100_000, help="Number of roads.")] = 1,
    max_angle: options.MaxAngle = 270,
) -> None:
    """Print random roads as a JSON list.

    Example: ds road generate --count 20 --seed 1 > roads.json
    """
    import numpy as np

    import ds_road

    rng = np.random.default_rng(seed)
    print(json.dumps([ds_road.generate(rng, max_angle=max_angle).control_points for _ in range(count)]))
    _say_next("generate", "--seed", seed, "--count", count, "--max-angle", max_angle)


@verb(road_app, "check")
def road_check_command(file: Annotated[Path, typer.Argument(metavar="FILE", help="JSON list of roads.")]) -> Result:
    """Check every road of a file: validity, length, curvature and turns.

    Example: ds road check roads.json
    """
    import ds_road

    document = [ds_road.check(raw) for raw in ds_road.read_raw_roads(file)]

    def show() -> None:
        table = Table("road", "valid", "length, m", "curvature, 1/m", "turns", "turns as in maxitwo", "reason")
        for index, row in enumerate(document):
            measured = row["length"] is not None
            table.add_row(
                str(index),
                "yes" if row["valid"] else "no",
                f"{row['length']:.1f}" if measured else "",
                f"{row['curvature']:.4f}" if measured else "",
                str(row["turns_count"]) if measured else "",
                str(row["turns_count_maxitwo"]) if measured else "",
                row["reason"],
            )
        Console().print(table)

    usable = document and all(row["valid"] for row in document)
    words = ("siblings", "compare", "--file", file) if usable else ("road", "generate")
    return Result(document=document, show=show, next=ds_command(*words))


@road_app.command("show")
def road_show_command(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="File with one road as JSON; a random one if left out.")
    ] = None,
    seed: options.Seed = 0,
    max_angle: options.MaxAngle = 270,
    lane: options.Lane = None,
    out: Annotated[Path, typer.Option(help="Picture to write, PNG.")] = Path("road.png"),
) -> None:
    """Draw a road as a PNG.

    Example: ds road show --seed 1 --out road.png
    """
    import ds_road
    from ds_base.folder_files import write_whole
    from ds_sim.camera.encodings import png

    write_whole(out, png(ds_road.draw(one_road(file, seed, max_angle, lane))))
    print(out)
    chosen = ("--seed", seed, "--max-angle", max_angle) if file is None else ("--road", file)
    say_next(ds_command("drive", "--sim", "bullet", *chosen, *(("--lane", lane) if lane else ())))


@road_app.command("export")
def road_export_command(
    file: Annotated[Path, typer.Argument(metavar="ROADS", help="JSON list of roads.")],
    out: Annotated[Path, typer.Option(help="Folder to write to, created if missing.")],
) -> None:
    """Export roads for other tools, as ASAM OpenDRIVE 1.7.

    Writes one file per road, named after its test or its place in the list, and prints their paths.

    Example: ds road export roads.json --out exported
    """
    import ds_road
    from ds_road.opendrive import write_all

    roads = ds_road.read_roads(file)
    raw = ds_road.read_raw_roads(file)
    names = [
        one["test_id"] if isinstance(one, dict) and isinstance(one.get("test_id"), str) else f"road_{index:04d}"
        for index, one in enumerate(raw)
    ]
    paths = write_all(roads, names, out)
    print(*paths, sep="\n")
    say_next(ds_command("road", "import", paths[0]))


Files = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILE...", help="OpenDRIVE, CommonRoad, JSON of the SBFT and SDC competitions, or a track's CSV."
    ),
]
LaneWidth = Annotated[
    float | None,
    typer.Option(
        min=1.0,
        max=20.0,
        help="Lane width of tracks, m; if left out, half of the track's width, all of it for --lane single, or 4.",
    ),
]
Scale = Annotated[
    float, typer.Option(min=0.01, max=100.0, help="Metres of the road per metre of a track: 10 for one of a 1:10 car.")
]
Strict = Annotated[bool, typer.Option("--strict", help="Refuse a file with a road that cannot be read.")]


@road_app.command("import")
def road_import_command(
    files: Files, lane_width: LaneWidth = None, lane: options.Lane = None, scale: Scale = 1.0, strict: Strict = False
) -> None:
    """Print the roads of other tools' files as a JSON list, for every verb that takes roads.

    The format is recognised by the content. Roads outside of the box of 250 m are moved into its middle if they fit. If
    they are larger, cut sections with `ds road cut`.

    Example: ds road import track.xodr > roads.json
    """
    _print_imported(("import", *files), files, lane_width, lane, scale, strict)


@road_app.command("cut")
def road_cut_command(
    files: Files,
    length: Annotated[float, typer.Option(min=20.0, max=900.0, help="Length of a section, m.")] = 200.0,
    every: Annotated[float, typer.Option(min=1.0, help="Distance between the starts of two sections, m.")] = 100.0,
    lane_width: LaneWidth = None,
    lane: options.Lane = None,
    scale: Scale = 1.0,
    strict: Strict = False,
) -> None:
    """Print sections of roads and tracks as a JSON list, such as those of a track that is larger than the box.

    Example: ds road cut track.csv --length 200 --every 100 > sections.json
    """
    words = ("cut", *files, "--length", length, "--every", every)
    _print_imported(words, files, lane_width, lane, scale, strict, sections=(length, every))


def _print_imported(
    words: Sequence[object],
    files: Sequence[Path],
    lane_width: float | None,
    lane: Side | None,
    scale: float,
    strict: bool,
    sections: tuple[float, float] | None = None,
) -> None:
    """Print roads of files, or sections of so much length at such distances, and what was left out."""
    from ds_base.left_out import LeftOut
    from ds_road.importing import import_roads

    left_out, document = LeftOut("roads", strict), []
    for file in files:
        for one in import_roads(file, left_out, lane_width=lane_width, lane=lane, scale=scale, sections=sections):
            document.append(one.to_json())
            if any(one.moved):
                say(f"{file}: {one.name} moved by ({one.moved[0]:g}, {one.moved[1]:g}) m into the box")
            if not one.road.validity.valid:
                reason = one.road.validity.reason
                remedy = ": try a smaller --lane-width" if "folds" in reason else ": `ds road cut` makes sections of it"
                say(f"{file}: {one.name} cannot be driven: {reason}{remedy}")
    if left_out.items:
        say(left_out.line())
    print(json.dumps(document))
    values = {"--lane-width": lane_width, "--lane": lane, "--scale": None if scale == 1.0 else scale}
    _say_next(*words, *(word for option, value in values.items() if value is not None for word in (option, value)))


def _say_next(*words: object) -> None:
    """What follows roads on standard output: a check of the file that it is, or the same `ds road` into a file."""
    kept = printed_to()
    say_next(ds_command("road", "check", kept) if kept else f"{ds_command('road', *words)} > roads.json")
