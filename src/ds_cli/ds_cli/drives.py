"""`ds drive` and `ds sensitivity`: a drive under conditions, and the strength at which they make a driver fail."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ds_bags.layout import Level
from ds_cli.one_drive import START_WAIT, DriveRequest, FailOn, drive
from ds_cli.options import (
    ALL,
    AttachFlag,
    Backend,
    Device,
    DriverName,
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
)
from ds_cli.output import Interrupted, Result, countdown, end, say
from ds_sim.conditions.model import Conditions, ConditionsError

if TYPE_CHECKING:
    from ds_studies.sensitivity.analysis import Sensitivity

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


def sensitivity(
    driver: str,
    simulators: list[str],
    conditions: list[str] | None,
    *,
    roads: int,
    levels: int,
    segments: int,
    seed: int,
    workers: int | None,
    out: Path | None,
    gates: Path | None,
) -> Result:
    """Find the strength of each condition at which a driver first fails.

    Args:
        driver: driver name, with its backend.
        simulators: names of the simulators.
        conditions: names of the conditions; None for all that have a harder end.
        roads: number of roads on each simulator.
        levels: number of levels of strength that may be driven.
        segments: length of each road, in segments of 25 m.
        seed: of the roads.
        workers: processes that drive; None for one per processor.
        out: folder to write to and to go on from, or None.
        gates: folder of the autopilot's drives; in `out` if None.

    Raises:
        ds_sim.conditions.ConditionsError: a condition is unknown, or has no harder end; or so many levels cannot be.
        ds_studies.kept_drives.KeptDrivesError: the folder holds drives of another driver.
        Interrupted: the user stopped it.
    """
    from rich.console import Console

    from ds_orchestrator.engines.preflight import check_driver
    from ds_orchestrator.store.folder_files import make_folder
    from ds_studies.sensitivity.analysis import analyse_sensitivity
    from ds_studies.sensitivity.factors import RESOLUTIONS, all_factors, factors_named

    if levels not in RESOLUTIONS:
        raise ConditionsError(f"--levels {levels} is not possible: expected {', '.join(map(str, RESOLUTIONS))}")
    factors = all_factors() if conditions is None else factors_named(conditions)
    check_driver(driver, simulators)
    if out is not None:
        make_folder(out)
    folder = None if out is None else out / "drives"
    try:
        found = analyse_sensitivity(
            driver, simulators, factors, roads=roads, levels=levels, segments=segments, seed=seed, workers=workers,
            folder=folder, gates=gates, progress=countdown(), say=say,
        )  # fmt: skip
    except KeyboardInterrupt:
        again = "" if folder is None else f"finished drives are in {folder}: the same command goes on"
        raise Interrupted(again) from None
    document = {"seed": seed, "segments": segments, "levels": levels, **found.document()}
    if out is not None:
        _write_sensitivity(out, document, found)

    def show() -> None:
        found.table().show(Console())
        for line in found.errors:
            print(f"error: {line}")
        if out is not None:
            print(out / "sensitivity.png")

    return Result(document=document, show=show, error=bool(found.errors))


def _write_sensitivity(out: Path, document: dict[str, Any], found: Sensitivity) -> None:
    from ds_analysis.common.table import write_tables
    from ds_sim.camera.encodings import png
    from ds_studies.sensitivity.picture import draw_sensitivity

    (out / "sensitivity.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    write_tables([found.table(), found.long_table()], out)
    (out / "sensitivity.png").write_bytes(png(draw_sensitivity(found)))


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
    workers: Workers = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables, picture and drives; a stopped analysis goes on there.")
    ] = None,
    gates: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the autopilot's drives, which other networks' analyses may use; in --out if left out."
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Find how strong each operating condition must be for a driver to fail.

    One condition at a time, for every simulator: the value at which the driver fails on the median road, by bisection,
    as far as the autopilot completes the same test. A condition that a simulator cannot realise is not applicable.
    """
    names = None if conditions is None else [name.strip() for name in conditions.split(",")]
    result = sensitivity(
        driver_named(driver, backend, "cpu"), every_or_named(sims), names, roads=roads, levels=levels,
        segments=segments, seed=seed, workers=workers, out=out, gates=gates,
    )  # fmt: skip
    end(result, as_json)
