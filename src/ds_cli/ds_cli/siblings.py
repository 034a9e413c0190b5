# SPDX-License-Identifier: Apache-2.0
"""`ds siblings compare`: how much the simulators agree, and what each adds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ds_base.folder_files import make_folder, whole_file, write_json, write_whole
from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.output import Result, number, say, stopped_in, verb
from ds_sim.registry import SimulatorName, colours_of

if TYPE_CHECKING:
    from ds_analysis.common.driven_road import DrivenRoad
    from ds_analysis.common.outcome_table import RoadTable
    from ds_analysis.siblings.analysis import PairComparison, SiblingAnalysis
    from ds_road import Road

TABLES = "tables.txt"
"""File with every table and sentence."""
PICTURED = 6
"""Roads that a comparison draws; chosen: a minute's look."""
TWIN = SimulatorName("donkey")
"""Simulator whose failures the others are to predict, where it is among them and no other is named."""

siblings_app = typer.Typer()


@verb(siblings_app, "compare")
def siblings_compare_command(
    driver: options.DriverText = "dave2",
    backend: options.Backend = "auto",
    roads: Annotated[int, typer.Option(min=1, help="Random roads.")] = 40,
    file: Annotated[
        Path | None, typer.Option(help="JSON with roads to drive instead of random ones, as of `ds campaign roads`.")
    ] = None,
    seed: options.Seed = 40,
    max_angle: options.MaxAngle = 270,
    lane: options.Lane = None,
    sims: options.Simulators = options.ALL,
    twin: Annotated[
        SimulatorName | None,
        options.simulator_option(
            "Simulator whose failures the others are to predict; donkey if it is among them, else each in turn."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for siblings.json, tables, pictures and drives; a stopped comparison is resumed."),
    ] = None,
    *,
    driving: options.DrivingAnywhere,
) -> Result:
    """Drive the same roads on several simulators: which fail where, and what each sibling adds.

    For every simulator you see the share of roads that the driver completes, and how well road features alone predict
    its failures. For every pair you see how far their failures agree. For every sibling you see the information that it
    adds about the twin beyond road features and the siblings before it. docs/evaluation.md says how each number is
    computed.

    Example: ds siblings compare --driver dave2 --out compared
    """
    from ds_analysis.common.outcome_table import table_of_runs
    from ds_analysis.siblings.analysis import analyse, compare, outcome_rows, summary
    from ds_cli.progress import ScreenListener
    from ds_cli.roads import roads_of
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.campaign.engine import DriveSettings
    from ds_orchestrator.engines.drive_tests import Callbacks
    from ds_studies.same_roads import drive_same_roads

    network, names = options.driver_named(driver, backend), options.every_or_named(sims)
    if len(names) < 2:
        raise ConfigError(f"simulators {', '.join(names)}: expected at least two, as --sims a,b")
    if twin is not None and twin not in names:
        raise ConfigError(f"twin {twin} is not among the simulators {', '.join(names)}: add it to --sims")
    settings = DriveSettings(siblings=tuple(names), driver=network, **driving.without_ros())
    chosen = roads_of(file, lane, count=roads, seed=seed, max_angle=max_angle)
    if out is not None:
        make_folder(out)
    folder = None if out is None else out / "drives"
    with stopped_in(folder):
        runs = drive_same_roads(settings, chosen, seed, folder, Callbacks(listen=ScreenListener))
    table = table_of_runs(runs)
    pairs, judged = compare(table), table.judged()
    say("analysing")
    about = twin or (TWIN if TWIN in names else None)
    analysis = analyse(judged, names if about is None else [about])
    document: dict[str, Any] = {
        "driver": str(network),
        "roads": len(chosen),
        "file": None if file is None else str(file),
        "seed": seed,
        "max_angle": max_angle if file is None else None,
        "lane": sorted({road.lane for road in chosen}),
        "simulators": {name: summary(of) for name, of in runs.items()},
        "pairs": [asdict(pair) for pair in pairs],
        "failed_on": {
            road.road_id: [name for name in names if runs[name][i].outcome.is_failure] for i, road in enumerate(chosen)
        },
        **analysis.document(),
        "outcomes": outcome_rows(judged),
        "left_out": len(table) - len(judged),
    }
    if out is not None:
        _write(out, document, chosen, runs, table, pairs, analysis)

    def show() -> None:
        for sentence in analysis.answer:
            print(sentence)
        Console().print(_simulator_table(document))
        print("Pairs, road features and what each sibling adds: with --out DIR" if out is None else out / TABLES)

    in_error = any(row["errors"] for row in document["simulators"].values())
    following = ds_command("test", driver) if out is None else ds_command("predict", out)
    return Result(document=document, show=show, error=in_error, next=following)


def _write(
    out: Path,
    document: dict[str, Any],
    roads: Sequence[Road],
    runs: dict[SimulatorName, list[DrivenRoad]],
    table: RoadTable,
    pairs: Sequence[PairComparison],
    analysis: SiblingAnalysis,
) -> None:
    """Write siblings.json, roads.json, pictures, and tables, once more with every sentence as text for people."""
    import ds_road
    from ds_analysis.common.outcome_table import SIBLINGS, SIBLINGS_VERSION
    from ds_analysis.siblings.analysis import APART, analysis_tables, most_different
    from ds_base.table import write_tables
    from ds_report.sections import draw_failures, draw_matrix
    from ds_sim.camera.encodings import png

    write_json(out / SIBLINGS, {"version": SIBLINGS_VERSION, **document})
    ds_road.write_roads(list(roads), out / "roads.json")
    tables = analysis_tables(analysis)
    write_tables(tables, out)
    judged = table.judged()
    if len(judged):
        write_whole(out / "failures.png", png(draw_failures(judged, analysis.feature, out / "failures")))
        matrix = draw_matrix(judged, analysis.feature, out / "who_fails_where")
        write_whole(out / "who_fails_where.png", png(matrix))
    for rank, index in enumerate(most_different(table, PICTURED)):
        paths = {name: of[index].path for name, of in runs.items()}
        picture = ds_road.draw(roads[index], trajectories=paths, colours=colours_of(list(paths)))
        write_whole(out / f"most_different_{rank + 1}.png", png(picture))
    distances = Table("pair", "Cohen's kappa", "median apart, m", "95%, m", f"over {APART:g} m apart", "correlation")
    for pair in pairs:
        kappa = _with_interval(pair.kappa, pair.kappa_interval) or "undefined"
        share = "" if pair.share_apart is None else f"{pair.share_apart:.0%}"
        meters = number(pair.median_apart), number(pair.apart_95)
        distances.add_row(f"{pair.first}, {pair.second}", kappa, *meters, share, number(pair.correlation))
    with whole_file(out / TABLES) as partial, partial.open("w", encoding="utf-8") as file:
        console = Console(file=file, width=140)
        console.print(_simulator_table(document), distances)
        for reason in sorted({pair.reason for pair in pairs if pair.reason}):
            console.print(f"kappa undefined: {reason}")
        for one in tables:
            one.show(console)
        for sentence in analysis.sentences:
            console.print(sentence)


def _simulator_table(document: dict[str, Any]) -> Table:
    table = Table("simulator", "roads", "completed", "failures", "errors", "median of max |lateral|, m")
    for name, row in document["simulators"].items():
        completed = "" if row["success_rate"] is None else f"{row['success_rate']:.0%}"
        median = row["median_max_lateral_position"]
        table.add_row(name, str(row["roads"]), completed, str(row["failures"]), str(row["errors"]), number(median))
    return table


def _with_interval(value: float | None, interval: tuple[float, float] | None) -> str:
    ends = " ({:.2f} to {:.2f})".format(*interval) if interval else ""
    return number(value) + ends if value is not None else ""
