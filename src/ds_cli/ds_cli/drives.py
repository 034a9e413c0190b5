# SPDX-License-Identifier: Apache-2.0
"""`ds drive`: runs one drive, through the graph of nodes or in a process without ROS, and writes its bag and video."""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ds_base.installation import ds_command
from ds_base.words import duration
from ds_cli.options import (
    AttachFlag,
    Backend,
    Device,
    DriverText,
    JsonFlag,
    Lane,
    MaxAngle,
    Simulator,
    Wait,
    complete_value,
    driver_named,
)
from ds_cli.output import Interrupted, Result, end, say, warning
from ds_sim.conditions.model import Conditions, ConditionsError
from ds_sim.registry import SimulatorName
from ds_sim.scenario import OfScenario, Scenario

if TYPE_CHECKING:
    from ds_driver.networks.driver_name import DriverName
    from ds_driver.networks.network_driver import Translation
    from ds_orchestrator.campaign.engine import EngineName
    from ds_road import Road
    from ds_sim.session import RunRecord

FailOn = Literal["error", "failure"]
Level = Literal["telemetry", "compressed", "raw"]
"""That of `ds_bags.layout`, whose import would delay every help text."""
COMMAND_TIMEOUT = 10.0
"""Seconds that a simulator waits for the driver's command; chosen: a network's first answer may load libraries."""
START_WAIT = 90.0
"""Seconds that nodes get to come up, importing their libraries on a busy machine included."""

app = typer.Typer()


@dataclass(frozen=True, kw_only=True)
class DriveOptions(OfScenario):
    """What `ds drive` was asked to do.

    Attributes:
        sim: simulator name.
        driver: driver name, with its backend.
        scenario: to drive; default conditions leave them to a running node.
        bag: rosbag2 folder to write, or None.
        level: what the bag holds.
        video: .mp4 to write, or None.
        attach: use running nodes; whatever driver runs there drives.
        wait: s to wait for the nodes.
        namespace: of the simulator.
        engine: what drives, `graph` or `local`.
    """

    sim: SimulatorName
    driver: DriverName
    scenario: Scenario
    bag: Path | None
    level: Level
    video: Path | None
    attach: bool
    wait: float
    namespace: str
    engine: EngineName


def in_words(document: dict[str, Any], road: Road) -> list[str]:
    """What a drive's result says, in the words and units of `ds bag info`."""
    outcome = document["outcome"].replace("_", " ").lower()
    why = f" ({document['message']})" if document["message"] else ""
    driven = f"{document['steps']} frames, {document['simulated_seconds']:.2f} s simulated"
    who = "The running driver" if document["driver"] == "attached" else document["driver"]
    lines = [f"{who} drove on {document['simulator']}: {outcome} after {driven}{why}."]
    if document["fitness"] is not None:
        inside, side = document["fitness"], document["max_lateral_position"]
        edge = f"{inside:.2f} m inside its lane" if inside >= 0.0 else f"{-inside:.2f} m out of its lane"
        lines.append(f"At worst the vehicle was {side:.2f} m off the lane's centre, {edge}.")
    radius = f", tightest bend {1.0 / road.curvature:.0f} m" if road.curvature else ""
    lines.append(
        f"Road {document['road_id']}: {road.length:.0f} m, {road.turns_count} turns{radius}; seed {document['seed']}; "
        f"took {duration(document['wall_seconds'])}."
    )
    if document["conditions"]:
        lines.append(f"Conditions {', '.join(f'{name}={value:g}' for name, value in document['conditions'].items())}.")
    lines += [f"{name}: {document[name]}" for name in ("video", "bag") if document[name]]
    return lines


def _check(request: DriveOptions) -> None:
    """Refuse what cannot work before anything starts."""
    import ds_road
    from ds_bags.layout import BagError
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.engines.preflight import check_driver
    from ds_orchestrator.graph.supervisor import check_ros
    from ds_sim.registry import spec_of
    from ds_sim.video import check_path

    if request.attach and request.engine != "graph":
        raise ConfigError(f"--engine {request.engine} starts no nodes: leave out --attach")
    if request.engine == "graph":
        check_ros()

    spec_of(request.sim).check(request.conditions)
    if not request.attach:
        check_driver(request.driver, [request.sim])
    road = request.road
    if not road.validity.valid:
        raise ds_road.RoadError(f"the road is not valid: {road.validity.reason}")
    if request.bag is not None and request.bag.exists():
        raise BagError(f"{request.bag} exists already: choose another folder")
    if request.bag is not None and request.attach and request.level != "telemetry":
        raise BagError(
            f"--level {request.level}: images of running nodes are not written: choose --level telemetry, and record "
            f"the images with `ros2 bag record {request.namespace}/camera/image_raw`"
        )
    if request.video is not None:
        check_path(request.video)


def _run_without_ros(request: DriveOptions) -> RunRecord:
    from ds_driver.closed_loop.drive_request import DriveRequest
    from ds_orchestrator.engines.local import running_local

    say(f"{request.sim} drives")
    with (
        tempfile.TemporaryDirectory(prefix="ds_drive_") as logs,
        running_local(request.driver, workers=1, command_timeout=COMMAND_TIMEOUT, logs=Path(logs)) as engine,
    ):
        return engine.drive(DriveRequest(request.scenario, request.driver, request.sim))


def _run(request: DriveOptions) -> RunRecord:
    if request.engine == "local":
        return _run_without_ros(request)
    from ds_cli.progress import DriveProgress
    from ds_orchestrator.graph.session import running_graph

    sim, namespace = request.sim, request.namespace
    if request.attach:
        say(f"waiting up to {duration(request.wait)} for the nodes in namespace {namespace}, ROS domain {_domain()}")
    else:
        say(f"starting {sim} and {request.driver}")
    with (
        tempfile.TemporaryDirectory(prefix="ds_drive_") as logs,
        running_graph(
            {sim: namespace},
            request.driver,
            command_timeout=COMMAND_TIMEOUT,
            logs=Path(logs),
            attach=request.attach,
            wait=request.wait if request.attach else START_WAIT,
        ) as client,
        DriveProgress(f"{sim} drives") as progress,
    ):
        own = request.attach and request.conditions.is_default  # those of the running node
        return client.execute(sim, request.scenario, conditions_of_node=own, watch=progress.update)


def _domain() -> str:
    return os.environ.get("ROS_DOMAIN_ID", "0")


def _translation(request: DriveOptions) -> Translation | None:
    """How the driver saw the images; None if as they are, or if an unknown driver drove."""
    from ds_driver.networks.network_driver import translation_of

    return None if request.attach else translation_of(request.driver, request.sim)


def seed_of(road: Path | None) -> int:
    """The seed that a road file of `ds campaign roads` names, else 0."""
    seed = _test_in(road).get("seed")
    return seed if isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32 else 0


def conditions_in(road: Path | None) -> Conditions:
    """The conditions that a road file of `ds campaign roads` names, else the default.

    Raises:
        ds_sim.ConditionsError: they cannot be.
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
    driver: DriverText = "dave2",
    backend: Backend = "auto",
    device: Device = "cpu",
    road: Annotated[
        Path | None,
        typer.Option(
            help="File with one road as JSON, such as from `ds campaign roads`. If left out, random, or its "
            "simulator's own."
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, max=2**32 - 1, help="Seed of the run and of a random road. If left out, as in the road file, or 0."
        ),
    ] = None,
    max_angle: MaxAngle = 270,
    lane: Lane = None,
    conditions: Annotated[
        str | None,
        typer.Option(
            help="Operating conditions, such as line_contrast=0.4,visibility=40. If left out, as in the road file.",
            autocompletion=complete_value,
        ),
    ] = None,
    bag: Annotated[Path | None, typer.Option(help="Folder of a rosbag2 to write.")] = None,
    level: Annotated[Level, typer.Option(help="What the bag holds.")] = "telemetry",
    video: Annotated[Path | None, typer.Option(help="Video of the drive to write, .mp4.")] = None,
    attach: AttachFlag = False,
    wait: Wait = START_WAIT,
    namespace: Annotated[str, typer.Option(help="Namespace of the simulator.")] = "/ds1",
    engine: Annotated[
        Literal["auto", "graph", "local"],
        typer.Option(
            help="What drives: graph (nodes of ROS), local (a process without ROS), or auto, which is graph where ROS "
            "is set up, else local. The result is the same."
        ),
    ] = "auto",
    fail_on: Annotated[
        FailOn, typer.Option(help="With failure: exit with 3 if the driver fails on the road; 1 is an error.")
    ] = "error",
    as_json: JsonFlag = False,
) -> None:
    """Drive one road with one driver on one simulator.

    Without --road the road is random. The driver fails when the vehicle leaves its lane.

    Exit status: 0 the drive has a verdict, 1 it ended in an error, 2 bad input, 3 the driver failed (only with
    --fail-on failure).

    Example: ds drive --sim donkey --driver dave2 --seed 7 --video drive.mp4
    """
    import numpy as np

    from ds_cli.roads import one_road
    from ds_driver.control.command_habits import command_habits
    from ds_orchestrator.campaign.engine import engine_here
    from ds_orchestrator.campaign.executor import trajectory_sha256
    from ds_sim.conditions.text import parse_conditions
    from ds_sim.registry import own_road_of
    from ds_sim.resimulation import resimulate
    from ds_sim.video import write_video

    chosen = seed if seed is not None else seed_of(road)
    network = driver_named(driver, backend, device)
    under = conditions_in(road) if conditions is None else parse_conditions(conditions)
    way = one_road(road, chosen, max_angle, lane, own=own_road_of(sim) if road is None else None)
    request = DriveOptions(
        sim=sim,
        driver=network,
        scenario=Scenario(way, under, seed=chosen),
        bag=bag,
        level=level,
        video=video,
        attach=attach,
        wait=wait,
        namespace=namespace,
        engine=engine_here(engine, attach=attach),
    )
    if bag is not None:
        from ds_bags.run_writer import write_bag  # before the drive, where its libraries are missing
    _check(request)
    started = time.monotonic()
    try:
        run = _run(request)
        whose = "attached" if attach else str(network)
        if bag is not None:
            write_bag(bag, namespace, sim, run, {"driver": whose}, level, translate=_translation(request))
        if video is not None:
            say(f"rendering {video}")
            # The images went to the driver alone; the same commands show them again.
            write_video(
                video,
                f"{sim}, {Path(whose).name}",
                request.road,
                resimulate(sim, run),
                run.commands,
                run.conditions,
                _translation(request),
            )
    except KeyboardInterrupt:
        if bag is not None and bag.exists():
            raise Interrupted(f"the bag is in {bag}") from None
        raise Interrupted from None
    wall = time.monotonic() - started
    habits = command_habits(
        np.array([one.steering for one in run.commands]), np.array([one.vehicle.speed for one in run.observations])
    )
    document: dict[str, Any] = {
        "simulator": sim,
        "driver": whose,
        "road_id": request.road.road_id,
        "seed": request.seed,
        "conditions": run.conditions.changed,
        "outcome": run.outcome.name,
        "message": run.message,
        "fitness": run.fitness if run.observations else None,
        "max_lateral_position": run.max_lateral_position if run.observations else None,
        "steps": run.steps,
        "simulated_seconds": run.simulated_seconds,
        "wall_seconds": round(wall, 3),
        "trajectory_sha256": trajectory_sha256(run),
        "bag": None if bag is None else str(bag),
        "video": None if video is None else str(video),
        "warnings": [habit.text for habit in habits],
    }

    def show() -> None:
        for line in in_words(document, request.road):
            print(line)
        for habit in habits:
            print(warning(whose, habit))

    unmet = [f"{whose} fails on the road"] if fail_on == "failure" and run.outcome.is_failure else []
    following = ds_command("test", "dave2" if whose in ("attached", "autopilot") else whose)
    error = run.outcome.is_error
    end(Result(document=document, show=show, error=error, unmet=unmet, next=following), as_json)
