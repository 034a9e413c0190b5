"""`ds drive`: one road, one driver, one simulator."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

import ds_road
from ds_orchestrator.campaign import execution_of
from ds_orchestrator.commands.answers import Interrupted, Result, end
from ds_orchestrator.commands.options import AttachFlag, Backend, Device, DriverName, JsonFlag, MaxAngle, driver_named
from ds_orchestrator.commands.roads import one_road

app = typer.Typer()


def drive(
    sim: str,
    driver: str,
    road: ds_road.Road,
    *,
    seed: int,
    bag: Path | None,
    video: Path | None,
    attach: bool,
    namespace: str,
) -> Result:
    """Drive one road through the graph; with `attach`, whatever driver runs there drives."""
    from ds_orchestrator.bags import BagError, write_bag
    from ds_orchestrator.graph_plan import check_driver
    from ds_orchestrator.redriving import redrive
    from ds_orchestrator.running import running_graph
    from ds_orchestrator.video import check_path, write_video
    from ds_sim.registry import make_simulator

    make_simulator(sim)
    if not attach:
        check_driver(driver)
    if road.sampled or road.published or road.lane_width != ds_road.LANE_WIDTH:
        # A road travels to a simulator as its control points alone, which would give another road here.
        raise ds_road.RoadError(
            "a road of road points, or of another lane width, can be checked and shown, not driven: give its control "
            f"points, with lanes of {ds_road.LANE_WIDTH:g} m"
        )
    if not road.validity.valid:
        raise ds_road.RoadError(f"the road is not valid: {road.validity.reason}")
    if bag is not None and bag.exists():
        raise BagError(f"{bag} exists already: choose another folder")
    if video is not None:
        check_path(video)
    namespaces = {sim: namespace}
    with tempfile.TemporaryDirectory(prefix="ds_drive_") as logs:
        try:
            with running_graph(namespaces, driver, command_timeout=10.0, logs=Path(logs), attach=attach) as executor:
                started = time.monotonic()
                run = executor.execute(sim, road, seed)
                wall = time.monotonic() - started
        except KeyboardInterrupt:
            raise Interrupted from None
    if bag is not None:
        write_bag(bag, namespaces[sim], run, {"simulator": sim, "driver": driver})
    whose = "attached" if attach else driver
    if video is not None:
        # The images travelled to the driver only; the same commands show them again.
        write_video(video, f"{sim}, {Path(whose).name}", road, redrive(sim, run), run.commands)
    execution = execution_of("", sim, run)
    document: dict[str, Any] = {
        "simulator": sim,
        "driver": whose,
        "road_id": road.road_id,
        "seed": seed,
        "outcome": run.outcome.name,
        "message": run.message,
        "fitness": run.fitness if run.observations else None,
        "max_lateral_position": run.max_lateral_position if run.observations else None,
        "steps": run.steps,
        "simulated_seconds": run.simulated_seconds,
        "wall_seconds": round(wall, 3),
        "trajectory_sha256": execution.trajectory_sha256,
    }

    def show() -> None:
        table = Table(show_header=False)
        for key, value in document.items():
            table.add_row(key, str(value))
        Console().print(table)

    return Result(document=document, show=show, error=run.outcome.is_error)


@app.command("drive")
def drive_command(
    sim: Annotated[str, typer.Option(help="bullet, softbody, donkey, donkey@FILE, or module:Class.")],
    driver: DriverName = "dave2",
    backend: Backend = "auto",
    device: Device = "cpu",
    road: Annotated[Path | None, typer.Option(help="File with one road as JSON.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the run, and of the road if no file is given.")] = 0,
    max_angle: MaxAngle = 270,
    bag: Annotated[Path | None, typer.Option(help="Write a rosbag2 folder here.")] = None,
    video: Annotated[Path | None, typer.Option(help="Write an .mp4 of the drive here.")] = None,
    attach: AttachFlag = False,
    namespace: Annotated[str, typer.Option(help="Of the simulator.")] = "/ds1",
    as_json: JsonFlag = False,
) -> None:
    """Drive one road and say how it went."""
    chosen = one_road(road, seed, max_angle)
    named = driver_named(driver, backend, device)
    result = drive(sim, named, chosen, seed=seed, bag=bag, video=video, attach=attach, namespace=namespace)
    end(result, as_json)
