"""`ds drive`: one road, one driver, one simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ds_bags.layout import Level
from ds_orchestrator.cli.one_drive import START_WAIT, DriveRequest, FailOn, drive
from ds_orchestrator.cli.options import (
    AttachFlag,
    Backend,
    Device,
    DriverName,
    JsonFlag,
    Lane,
    MaxAngle,
    Simulator,
    Wait,
    driver_named,
)
from ds_orchestrator.cli.output import end

app = typer.Typer()


def seed_of(road: Path | None) -> int:
    """The seed that a road file of `ds campaign roads` names, else 0."""
    from ds_road import read_raw_roads

    raw = read_raw_roads(road) if road is not None else []
    seed = raw[0].get("seed") if len(raw) == 1 and isinstance(raw[0], dict) else None
    return seed if isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32 else 0


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
        str, typer.Option(help="Operating conditions, such as line_contrast=0.4,visibility=40; docs/conditions.md.")
    ] = "",
    bag: Annotated[Path | None, typer.Option(help="Folder of a rosbag2 to write.")] = None,
    level: Annotated[Level, typer.Option(help="What the bag holds.")] = "telemetry",
    video: Annotated[Path | None, typer.Option(help="Video of the drive to write, .mp4.")] = None,
    attach: AttachFlag = False,
    wait: Wait = START_WAIT,
    namespace: Annotated[str, typer.Option(help="Namespace of the simulator.")] = "/ds1",
    fail_on: Annotated[
        FailOn, typer.Option(help="Exit with 1 on errors only, or if the driver fails on the road too.")
    ] = "error",
    as_json: JsonFlag = False,
) -> None:
    """Drive one road with one driver on one simulator.

    The driver fails when the vehicle leaves its lane. Exit status: 0 the drive has a verdict, 1 it ended in an error
    (with --fail-on failure: or the driver failed), 2 bad input.
    """
    from ds_orchestrator.cli.roads import one_road
    from ds_sim.conditions.text import parse_conditions

    chosen = seed if seed is not None else seed_of(road)
    request = DriveRequest(
        sim=sim, driver=driver_named(driver, backend, device), road=one_road(road, chosen, max_angle, lane),
        seed=chosen, bag=bag, level=level, video=video, attach=attach, wait=wait, namespace=namespace, fail_on=fail_on,
        conditions=parse_conditions(conditions),
    )  # fmt: skip
    end(drive(request), as_json)
