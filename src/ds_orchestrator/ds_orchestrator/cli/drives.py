"""`ds drive`: one road, one driver, one simulator."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

import ds_road
from ds_bags.layout import Level
from ds_orchestrator.campaign.runner import execution_of
from ds_orchestrator.cli.options import AttachFlag, Backend, Device, DriverName, JsonFlag, MaxAngle, driver_named
from ds_orchestrator.cli.output import Interrupted, Result, end, say
from ds_orchestrator.cli.roads import one_road
from ds_sim.registry import SIMULATORS
from ds_sim.session import RunRecord

if TYPE_CHECKING:
    from ds_bags.ros.image_recorder import ImageRecorder
    from ds_orchestrator.graph.executor import GraphExecutor

app = typer.Typer()


def drive(
    sim: str,
    driver: str,
    road: ds_road.Road,
    *,
    seed: int,
    bag: Path | None,
    level: Level,
    video: Path | None,
    attach: bool,
    namespace: str,
) -> Result:
    """Drive one road through the graph; with `attach`, whatever driver runs there drives."""
    from ds_bags.layout import BagError
    from ds_orchestrator.graph.process_specs import check_driver
    from ds_orchestrator.graph.session import running_graph
    from ds_sim.registry import make_simulator
    from ds_sim.resimulation import resimulate
    from ds_sim.video import check_path, write_video

    make_simulator(sim).close()
    if not attach:
        check_driver(driver)
    if not road.validity.valid:
        raise ds_road.RoadError(f"the road is not valid: {road.validity.reason}")
    if bag is not None and bag.exists():
        raise BagError(f"{bag} exists already: choose another folder")
    if video is not None:
        check_path(video)
    namespaces = {sim: namespace}
    with tempfile.TemporaryDirectory(prefix="ds_drive_") as logs:
        try:
            with (
                running_graph(namespaces, driver, command_timeout=10.0, logs=Path(logs), attach=attach) as executor,
                _recorder(executor, bag, level, sim, namespace, road, seed, attach) as recorder,
            ):
                started = time.monotonic()
                run = executor.execute(sim, road, seed)
                wall = time.monotonic() - started
                if recorder is not None and not recorder.wait_for_images(len(run.observations)):
                    say(f"only {recorder.images} of {len(run.observations)} images arrived here")
        except KeyboardInterrupt:
            raise Interrupted from None
    whose = "attached" if attach else driver
    if bag is not None:
        _keep_bag(bag, namespace, sim, run, {"driver": whose}, level, seen=recorder is not None)
    if video is not None:
        # The images travelled to the driver only; the same commands show them again.
        write_video(video, f"{sim}, {Path(whose).name}", road, resimulate(sim, run), run.commands)
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


@contextmanager
def _recorder(
    executor: GraphExecutor,
    bag: Path | None,
    level: Level,
    sim: str,
    namespace: str,
    road: ds_road.Road,
    seed: int,
    attach: bool,
) -> Iterator[ImageRecorder | None]:
    """Records the images of a simulator that is not ours to drive again; None where none is needed.

    What runs somewhere else may be another version with another look, and a simulator of the user's own may not come
    out the same: there the driver's images are taken from the graph.
    """
    from ds_bags.layout import image_spool_path
    from ds_bags.run_writer import facts_of
    from ds_orchestrator.graph.executor import GraphError

    if bag is None or level == "telemetry" or not (attach or sim.partition("@")[0] not in SIMULATORS):
        yield None
        return
    from ds_bags.ros.image_recorder import ImageRecorder

    folder = image_spool_path(bag)
    shutil.rmtree(folder.parent, ignore_errors=True)
    facts = facts_of(sim, RunRecord(road=road, seed=seed), level)
    with ImageRecorder(folder, namespace, facts, executor.context) as recorder:
        if not recorder.wait_for_camera():
            raise GraphError(f"{namespace} publishes no camera/image_raw to record: choose --level telemetry")
        yield recorder


def _keep_bag(
    bag: Path, namespace: str, sim: str, run: RunRecord, about: dict[str, str], level: Level, *, seen: bool
) -> None:
    """Write the bag, with the images that were recorded or those of driving again."""
    from ds_bags.layout import image_spool_path
    from ds_bags.run_writer import write_bag

    if not seen:
        write_bag(bag, namespace, sim, run, about, level)
        return
    from ds_bags.ros.image_recorder import with_images

    write_bag(bag, namespace, sim, run, about, level, with_images(run, image_spool_path(bag)))
    shutil.rmtree(image_spool_path(bag).parent)


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
    level: Annotated[Level, typer.Option(help="What the bag holds.")] = "telemetry",
    as_json: JsonFlag = False,
) -> None:
    """Drive one road and say how it went."""
    chosen = one_road(road, seed, max_angle)
    named = driver_named(driver, backend, device)
    result = drive(sim, named, chosen, seed=seed, bag=bag, level=level, video=video, attach=attach, namespace=namespace)
    end(result, as_json)
