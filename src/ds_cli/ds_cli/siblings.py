"""`ds siblings compare`: how much the simulators agree, and what each adds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ds_cli.options import (
    ALL,
    Backend,
    DriverName,
    JsonFlag,
    Lane,
    MaxAngle,
    Seed,
    Simulators,
    Workers,
    driver_named,
    every_or_named,
)
from ds_cli.output import Interrupted, Result, countdown, end, number, say

if TYPE_CHECKING:
    from ds_analysis.paper.simulator_agreement import PairComparison
    from ds_analysis.siblings.analysis import SiblingAnalysis
    from ds_analysis.siblings.outcomes import Outcomes
    from ds_driver.closed_loop.drive_request import DriveRequest
    from ds_road import Road, Side
    from ds_sim.session import RunRecord

PICTURED = 6
"""Roads that a comparison draws; chosen: a minute's look."""
TWIN = "donkey"
"""Simulator whose failures the others are to predict, where it is among them and no other is named."""

app = typer.Typer()
siblings_app = typer.Typer(help="Compare how the simulators behave.", no_args_is_help=True)
app.add_typer(siblings_app, name="siblings")


@dataclass(frozen=True, kw_only=True)
class ComparisonRequest:
    """What `ds siblings compare` was asked to do.

    Attributes:
        driver: driver name, with its backend.
        simulators: names, siblings in the order in which they are added.
        twin: simulator whose failures are to be predicted; None for the usual one, or else every simulator in turn.
        roads: number of random roads.
        file: file of roads to drive instead, or None.
        seed: of the random roads, and of the run on the first road; it increases by one per road.
        max_angle: of the random roads, degrees.
        lane: lane to drive; None for the roads' own.
        workers: processes that drive; None for one per processor.
        out: folder to write to and to go on from, or None.
    """

    driver: str
    simulators: list[str]
    twin: str | None
    roads: int
    file: Path | None
    seed: int
    max_angle: int
    lane: Side | None
    workers: int | None
    out: Path | None


def compare_siblings(request: ComparisonRequest) -> Result:
    """Drive the same roads with the same driver on every simulator, and compare outcomes and trajectories.

    Raises:
        ds_orchestrator.campaign.config.ConfigError: fewer than two simulators, or an unknown twin.
        ds_studies.kept_drives.KeptDrivesError: the folder holds drives of another driver.
        ds_road.RoadError: the file holds no roads, or one that cannot be driven.
        Interrupted: the user stopped it.
    """
    from ds_analysis.paper.simulator_agreement import compare
    from ds_analysis.siblings.analysis import analyse
    from ds_analysis.siblings.outcomes import outcomes_of_runs

    about = _check(request)
    drives, roads = _drives(request)
    runs = _driven(request, drives)
    pairs = compare(runs)
    outcomes = outcomes_of_runs(runs)
    say("analysing")
    found = analyse(outcomes, about)
    document = _document(request, roads, runs, pairs, outcomes, found)
    if request.out is not None:
        _write(request.out, document, roads, runs, outcomes, found)

    def show() -> None:
        _show(document, pairs, found)
        if request.out is not None:
            print(request.out)

    return Result(document=document, show=show, error=any(row["errors"] for row in document["simulators"].values()))


def _check(request: ComparisonRequest) -> list[str]:
    """Refuse what cannot work before anything is driven; returns the simulators whose failures are to be predicted."""
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.engines.preflight import check_driver
    from ds_orchestrator.store.folder_files import make_folder

    names = request.simulators
    if len(names) < 2:
        raise ConfigError(f"simulators {', '.join(names)}: expected at least two, as --sims a,b")
    if request.twin is not None and request.twin not in names:
        raise ConfigError(f"twin {request.twin} is not among the simulators {', '.join(names)}: add it to --sims")
    check_driver(request.driver, names)
    if request.out is not None:
        make_folder(request.out)
    twin = request.twin or (TWIN if TWIN in names else None)
    return names if twin is None else [twin]


def _drives(request: ComparisonRequest) -> tuple[list[DriveRequest], list[Road]]:
    """Every road on every simulator, and the roads."""
    import ds_road
    from ds_driver.closed_loop.drive_request import DriveRequest
    from ds_driver.closed_loop.success_rate import unseen_roads

    if request.file is None:
        roads = unseen_roads(request.roads, request.seed, max_angle=request.max_angle)
    else:
        roads = ds_road.read_roads(request.file)
        if not roads:
            raise ds_road.RoadError(f"{request.file}: no roads, expected at least one")
    if request.lane is not None:
        roads = [road.in_lane(request.lane) for road in roads]
    for index, road in enumerate(roads):
        if not road.validity.valid:
            raise ds_road.RoadError(f"road {index} is not valid: {road.validity.reason}: leave it out")
    drives = [
        DriveRequest(name, request.driver, road, request.seed + index)
        for index, road in enumerate(roads)
        for name in request.simulators
    ]
    return drives, roads


def _driven(request: ComparisonRequest, drives: Sequence[DriveRequest]) -> dict[str, list[RunRecord]]:
    """The runs of every simulator, in the order of the roads."""
    from ds_studies.kept_drives import drive_kept

    runs: dict[str, list[RunRecord]] = {name: [] for name in request.simulators}
    folder = None if request.out is None else request.out / "drives"
    progress, kept = countdown(), 0
    try:
        found = drive_kept(drives, folder, workers=request.workers, say=say)
        for done, (drive, (run, fresh)) in enumerate(zip(drives, found, strict=True), start=1):
            runs[drive.simulator].append(run)
            kept += not fresh
            if fresh:
                line = f"{run.road.road_id} on {drive.simulator}: {run.outcome.name.lower()}"
                progress(done - kept, len(drives) - kept, line)
    except KeyboardInterrupt:
        again = "" if folder is None else f"finished drives are in {folder}: the same command goes on"
        raise Interrupted(again) from None
    if kept:
        say(f"{kept} of {len(drives)} drives were in {folder}")
    return runs


def _document(
    request: ComparisonRequest,
    roads: Sequence[Road],
    runs: dict[str, list[RunRecord]],
    pairs: Sequence[PairComparison],
    outcomes: Outcomes,
    found: SiblingAnalysis,
) -> dict[str, Any]:
    from ds_analysis.paper.simulator_agreement import summary
    from ds_analysis.siblings.analysis import outcome_rows

    return {
        "driver": request.driver,
        "roads": len(roads),
        "file": None if request.file is None else str(request.file),
        "seed": request.seed,
        "max_angle": request.max_angle if request.file is None else None,
        "lane": sorted({road.lane for road in roads}),
        "simulators": {name: summary(of) for name, of in runs.items()},
        "pairs": [asdict(pair) for pair in pairs],
        "failed_on": {
            road.road_id: [n for n in request.simulators if runs[n][i].outcome.is_failure]
            for i, road in enumerate(roads)
        },
        **found.document(),
        "outcomes": outcome_rows(outcomes),
        "left_out": outcomes.left_out,
    }


def _write(
    out: Path,
    document: dict[str, Any],
    roads: Sequence[Road],
    runs: dict[str, list[RunRecord]],
    outcomes: Outcomes,
    found: SiblingAnalysis,
) -> None:
    """Write comparison.json, roads.json, tables and pictures."""
    import numpy as np

    import ds_road
    from ds_analysis.common.table import write_tables
    from ds_analysis.paper.simulator_agreement import most_different
    from ds_analysis.siblings.analysis import analysis_tables
    from ds_analysis.siblings.pictures import draw_failures, draw_matrix
    from ds_sim.camera.encodings import png

    (out / "comparison.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    ds_road.write_roads(list(roads), out / "roads.json")
    write_tables(analysis_tables(found), out)
    if outcomes.roads:
        (out / "failures.png").write_bytes(png(draw_failures(outcomes, found.feature)))
        (out / "who_fails_where.png").write_bytes(png(draw_matrix(outcomes, found.feature)))
    for rank, index in enumerate(most_different(runs, PICTURED)):
        paths = {
            name: np.array([(o.vehicle.x, o.vehicle.y) for o in of[index].observations]) for name, of in runs.items()
        }
        (out / f"most_different_{rank + 1}.png").write_bytes(png(ds_road.draw(roads[index], trajectories=paths)))


def _show(document: dict[str, Any], pairs: Sequence[PairComparison], found: SiblingAnalysis) -> None:
    from ds_analysis.paper.simulator_agreement import APART
    from ds_analysis.siblings.analysis import analysis_tables

    table = Table("simulator", "roads", "failures", "errors", "median of max |lateral|, m")
    for name, row in document["simulators"].items():
        median = row["median_max_lateral_position"]
        table.add_row(name, str(row["roads"]), str(row["failures"]), str(row["errors"]), number(median))
    console = Console()
    console.print(table)
    distances = Table("pair", "Cohen's kappa", "median apart, m", "95 %, m", f"over {APART:g} m apart", "correlation")
    for pair in pairs:
        names = f"{pair.first}, {pair.second}"
        kappa = _with_interval(pair.kappa, pair.kappa_interval) or "undefined"
        share = "" if pair.share_apart is None else f"{pair.share_apart:.0%}"
        distances.add_row(
            names, kappa, number(pair.median_apart), number(pair.apart_95), share, number(pair.correlation)
        )
    for reason in sorted({pair.reason for pair in pairs if pair.reason}):
        print(f"kappa undefined: {reason}")
    console.print(distances)
    for one in analysis_tables(found):
        one.show(console)
    for sentence in found.sentences:
        print(sentence)


def _with_interval(value: float | None, interval: tuple[float, float] | None) -> str:
    ends = " ({:.2f} to {:.2f})".format(*interval) if interval else ""
    return number(value) + ends if value is not None else ""


@siblings_app.command("compare")
def siblings_compare_command(
    driver: DriverName = "dave2",
    backend: Backend = "auto",
    roads: Annotated[int, typer.Option(min=1, help="Random roads.")] = 40,
    file: Annotated[
        Path | None, typer.Option(help="JSON with roads to drive instead of random ones, as of `ds campaign roads`.")
    ] = None,
    seed: Seed = 40,
    max_angle: MaxAngle = 270,
    lane: Lane = None,
    sims: Simulators = ALL,
    twin: Annotated[
        str | None,
        typer.Option(
            help="Simulator whose failures the others are to predict; donkey if it is among them, else each in turn."
        ),
    ] = None,
    workers: Workers = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for comparison.json, tables, pictures and drives; a stopped comparison goes on there."
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Drive the same roads on several simulators: which fail where, and what each sibling adds.

    For every pair: how far their failures agree and lie inside each other. For every simulator: how well road features
    alone predict its failures. For every sibling: the information that it adds about the twin beyond these features and
    the siblings before it. docs/evaluation.md says how each number is computed.
    """
    request = ComparisonRequest(
        driver=driver_named(driver, backend, "cpu"), simulators=every_or_named(sims), twin=twin, roads=roads, file=file,
        seed=seed, max_angle=max_angle, lane=lane, workers=workers, out=out,
    )  # fmt: skip
    end(compare_siblings(request), as_json)
