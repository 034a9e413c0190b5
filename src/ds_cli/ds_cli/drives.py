"""`ds drive` and `ds sensitivity`: a drive under conditions, and the strength at which they make a driver fail."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from ds_bags.layout import Level
from ds_cli.one_drive import START_WAIT, DriveRequest, FailOn, drive
from ds_cli.options import (
    ALL,
    AttachFlag,
    Backend,
    Cluster,
    Device,
    DriverName,
    EngineName,
    JsonFlag,
    Lane,
    MaxAngle,
    Seed,
    Simulator,
    Simulators,
    Wait,
    Workers,
    driver_named,
    every_or_named,
    with_engine_without_ros,
)
from ds_cli.output import Result, countdown, end, say, stopped_in
from ds_sim.conditions.model import Conditions, ConditionsError

app = typer.Typer()


def seed_of(road: Path | None) -> int:
    """The seed that a road file of `ds campaign roads` names, else 0."""
    seed = _test_in(road).get("seed")
    return seed if isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32 else 0


def conditions_in(road: Path | None) -> Conditions:
    """The conditions that a road file of `ds campaign roads` names, else the default.

    Raises:
        ds_sim.conditions.ConditionsError: they cannot be.
    """
    from ds_sim.conditions.text import parse_conditions

    text = _test_in(road).get("conditions", "")
    if not isinstance(text, str):
        raise ConditionsError(f"{road}: its conditions are not a text, expected such as visibility=40")
    return parse_conditions(text)


def _test_in(road: Path | None) -> dict[str, Any]:
    """What a file of one road holds beside it."""
    from ds_road import read_raw_roads

    raw = read_raw_roads(road) if road is not None else []
    return raw[0] if len(raw) == 1 and isinstance(raw[0], dict) else {}


@app.command("drive")
def drive_command(
    sim: Simulator,
    driver: DriverName = "dave2",
    backend: Backend = "auto",
    device: Device = "cpu",
    road: Annotated[
        Path | None,
        typer.Option(help="File with one road as JSON, such as from `ds campaign roads`; random if left out."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, max=2**32 - 1, help="Seed of the run, and of the random road; the road file's if left out, or 0."
        ),
    ] = None,
    max_angle: MaxAngle = 270,
    lane: Lane = None,
    conditions: Annotated[
        str | None,
        typer.Option(
            help="Operating conditions, such as line_contrast=0.4,visibility=40; the road file's if left out, or none."
        ),
    ] = None,
    bag: Annotated[Path | None, typer.Option(help="Folder of a rosbag2 to write.")] = None,
    level: Annotated[Level, typer.Option(help="What the bag holds.")] = "telemetry",
    video: Annotated[Path | None, typer.Option(help="Video of the drive to write, .mp4.")] = None,
    attach: AttachFlag = False,
    wait: Wait = START_WAIT,
    namespace: Annotated[str, typer.Option(help="Namespace of the simulator.")] = "/ds1",
    fail_on: Annotated[
        FailOn, typer.Option(help="With failure: exit with 3 if the driver fails on the road; 1 is an error.")
    ] = "error",
    as_json: JsonFlag = False,
) -> None:
    """Drive one road with one driver on one simulator.

    The driver fails when the vehicle leaves its lane. Exit status: 0 the drive has a verdict, 1 it ended in an error,
    2 bad input, 3 the driver failed (only with --fail-on failure).
    """
    from ds_cli.roads import one_road
    from ds_sim.conditions.text import parse_conditions

    chosen = seed if seed is not None else seed_of(road)
    request = DriveRequest(
        sim=sim, driver=driver_named(driver, backend, device), road=one_road(road, chosen, max_angle, lane),
        seed=chosen, bag=bag, level=level, video=video, attach=attach, wait=wait, namespace=namespace, fail_on=fail_on,
        conditions=conditions_in(road) if conditions is None else parse_conditions(conditions),
    )  # fmt: skip
    end(drive(request), as_json)


@app.command("sensitivity")
def sensitivity_command(
    driver: DriverName = "dave2",
    backend: Backend = "auto",
    sims: Simulators = ALL,
    conditions: Annotated[
        str | None,
        typer.Option(help="Names of conditions, separated by commas; all of docs/conditions.md if left out."),
    ] = None,
    roads: Annotated[
        int, typer.Option(min=1, max=100, help="Short roads on each simulator that the driver completes by default.")
    ] = 3,
    levels: Annotated[
        int, typer.Option(help="Levels of strength that may be driven up to the hardest value: 4, 8 or 16.")
    ] = 8,
    segments: Annotated[
        int, typer.Option(min=2, max=6, help="Length of the roads in segments of 25 m; 6 are the roads of a campaign.")
    ] = 4,
    seed: Seed = 1,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables, picture and drives; a stopped analysis goes on there.")
    ] = None,
    gates: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the autopilot's drives, which other networks' analyses may use; in --out if left out."
        ),
    ] = None,
    workers: Workers = None,
    engine: EngineName = None,
    cluster: Cluster = None,
    as_json: JsonFlag = False,
) -> None:
    """Find how strong each operating condition must be for a driver to fail.

    One condition at a time, for every simulator: the value at which the driver fails on the median road, by bisection,
    as far as the autopilot completes the same test. A condition that a simulator cannot realise is not applicable.
    """
    from rich.console import Console

    from ds_analysis.common.table import write_tables
    from ds_orchestrator.campaign.engine import DriveSettings
    from ds_orchestrator.store.folder_files import make_folder
    from ds_sim.camera.encodings import png
    from ds_studies.sensitivity.analysis import analyse_sensitivity
    from ds_studies.sensitivity.factors import RESOLUTIONS, all_factors, factors_named
    from ds_studies.sensitivity.picture import draw_sensitivity

    driver, names = driver_named(driver, backend, "cpu"), every_or_named(sims)
    if levels not in RESOLUTIONS:
        raise ConditionsError(f"--levels {levels} is not possible: expected {', '.join(map(str, RESOLUTIONS))}")
    factors = all_factors() if conditions is None else factors_named([c.strip() for c in conditions.split(",")])
    settings = with_engine_without_ros(DriveSettings(siblings=tuple(names), driver=driver), workers, engine, cluster)
    if out is not None:
        make_folder(out)
    folder = None if out is None else out / "drives"
    with stopped_in(folder):
        found = analyse_sensitivity(
            settings, factors, roads=roads, levels=levels, segments=segments, seed=seed, folder=folder, gates=gates,
            progress=countdown(), say=say,
        )  # fmt: skip
    document = {"seed": seed, "segments": segments, "levels": levels, **found.document()}
    if out is not None:
        (out / "sensitivity.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
        write_tables([found.table(), found.long_table()], out)
        (out / "sensitivity.png").write_bytes(png(draw_sensitivity(found)))

    def show() -> None:
        found.table().show(Console())
        for line in found.errors:
            print(f"error: {line}")
        if out is not None:
            print(out / "sensitivity.png")

    end(Result(document=document, show=show, error=bool(found.errors)), as_json)
