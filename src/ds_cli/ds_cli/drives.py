# SPDX-License-Identifier: Apache-2.0
"""`ds drive`, `ds serve`: one drive with its bag and video, by nodes or without ROS; a simulator for other clients."""

from __future__ import annotations

import asyncio
import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ds_base.installation import ds_command
from ds_base.words import duration
from ds_cli import options
from ds_cli.output import Interrupted, Result, say, say_next, verb, warning
from ds_cli.roads import one_road, roads_of
from ds_sim.conditions.model import ConditionsError
from ds_sim.conditions.text import parse_conditions
from ds_sim.registry import SimulatorName, own_road_of, spec_of
from ds_sim.scenario import Scenario

if TYPE_CHECKING:
    from ds_driver.networks.driver_name import DriverName
    from ds_road import Road
    from ds_sim.session import RunRecord

Level = Literal["telemetry", "compressed", "raw"]
"""That of `ds_bags.layout`, whose import would delay every help text."""
COMMAND_TIMEOUT = 10.0
"""Seconds that a simulator waits for the driver's command; chosen: a network's first answer may load libraries."""
START_WAIT = 90.0
"""Seconds that nodes get to come up, importing their libraries on a busy machine included."""

app = typer.Typer()


def drive_in_words(document: dict[str, Any], road: Road) -> list[str]:
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


def _run_without_ros(sim: SimulatorName, driver: DriverName, scenario: Scenario) -> RunRecord:
    from ds_driver.closed_loop.simulation import DriveRequest
    from ds_orchestrator.engines.local import running_local

    say(f"{sim} drives")
    with (
        tempfile.TemporaryDirectory(prefix="ds_drive_") as logs,
        running_local(driver, workers=1, command_timeout=COMMAND_TIMEOUT, logs=Path(logs)) as engine,
    ):
        return engine.drive(DriveRequest(scenario, driver, sim))


def _run_on_nodes(
    sim: SimulatorName, driver: DriverName, scenario: Scenario, namespace: str, *, attach: bool, wait: float
) -> RunRecord:
    """Drive on nodes that are started, or on running ones, whose own conditions count where none are named."""
    from ds_cli.progress import drive_progress
    from ds_orchestrator.graph.session import running_graph

    if attach:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        say(f"waiting up to {duration(wait)} for the nodes in namespace {namespace}, ROS domain {domain}")
    else:
        say(f"starting {sim} and {driver}")
    with (
        tempfile.TemporaryDirectory(prefix="ds_drive_") as logs,
        running_graph(
            {sim: namespace},
            driver,
            command_timeout=COMMAND_TIMEOUT,
            logs=Path(logs),
            attach=attach,
            wait=wait if attach else START_WAIT,
        ) as client,
        drive_progress(f"{sim} drives") as watch,
    ):
        own = attach and scenario.conditions.is_default
        return client.execute(sim, scenario, conditions_of_node=own, watch=watch)


def _test_in(road: Path | None) -> tuple[int, object]:
    """Seed and conditions that a file of one road has beside it, as of `ds campaign roads`; else 0 and none."""
    from ds_road import read_raw_roads

    raw = read_raw_roads(road) if road is not None else []
    about = raw[0] if len(raw) == 1 and isinstance(raw[0], dict) else {}
    seed, conditions = about.get("seed"), about.get("conditions", "")
    if isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32:
        return seed, conditions
    return 0, conditions


@verb(app, "drive")
def drive_command(
    sim: options.Simulator,
    driver: options.DriverText = "dave2",
    backend: options.Backend = "auto",
    device: Annotated[str, typer.Option(help="cpu, or cuda for PyTorch on a GPU.")] = "cpu",
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
    max_angle: options.MaxAngle = 270,
    lane: options.Lane = None,
    conditions: Annotated[
        str | None,
        typer.Option(
            help="Operating conditions, such as line_contrast=0.4,visibility=40. If left out, as in the road file.",
            autocompletion=options.complete_value,
        ),
    ] = None,
    bag: Annotated[Path | None, typer.Option(help="Folder of a rosbag2 to write.")] = None,
    level: Annotated[Level, typer.Option(help="What the bag holds.")] = "telemetry",
    video: Annotated[Path | None, typer.Option(help="Video of the drive to write, .mp4.")] = None,
    attach: options.AttachFlag = False,
    wait: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="With --attach: wait at most this many seconds for the nodes.")
    ] = START_WAIT,
    namespace: Annotated[str, typer.Option(help="Namespace of the simulator.")] = "/ds1",
    engine: Annotated[
        Literal["auto", "graph", "local"],
        typer.Option(
            help="What drives: graph (nodes of ROS), local (a process without ROS), or auto, which is graph where ROS "
            "is set up, else local. The result is the same."
        ),
    ] = "auto",
    fail_on: Annotated[
        Literal["error", "failure"],
        typer.Option(help="With failure: exit with 3 if the driver fails on the road; 1 is an error."),
    ] = "error",
) -> Result:
    """Drive one road with one driver on one simulator.

    Without --road the road is random. The driver fails when the vehicle leaves its lane.

    Exit status: 0 the drive has a verdict, 1 it ended in an error, 2 bad input, 3 the driver failed (only with
    --fail-on failure).

    Example: ds drive --sim donkey --driver dave2 --seed 7 --video drive.mp4
    """
    import numpy as np

    from ds_bags.layout import BagError
    from ds_driver.control.command_habits import command_habits
    from ds_driver.networks.driver_name import AUTOPILOT
    from ds_driver.networks.network_driver import translation_of
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.campaign.engine import engine_here
    from ds_orchestrator.campaign.executor import trajectory_sha256
    from ds_orchestrator.engines.start import check_driver
    from ds_orchestrator.graph.supervisor import check_ros
    from ds_road import RoadError
    from ds_sim.session import resimulate
    from ds_sim.video import check_path, write_video

    own_seed, own_conditions = _test_in(road)
    chosen = own_seed if seed is None else seed
    network = options.driver_named(driver, backend, device)
    said = own_conditions if conditions is None else conditions
    if not isinstance(said, str):
        raise ConditionsError(f"{road}: its conditions are not a text, expected such as visibility=40")
    under = parse_conditions(said)
    way = one_road(road, chosen, max_angle, lane, own=own_road_of(sim) if road is None else None)
    scenario, used_engine = Scenario(way, under, seed=chosen), engine_here(engine, attach=attach)
    if bag is not None:
        from ds_bags.run_writer import write_bag  # before the drive, where its libraries are missing
    if attach and used_engine != "graph":
        raise ConfigError(f"--engine {used_engine} starts no nodes: leave out --attach")
    if used_engine == "graph":
        check_ros()
    spec_of(sim).check(under)
    if not attach:
        check_driver(network, [sim])
    if not way.validity.valid:
        raise RoadError(f"the road is not valid: {way.validity.reason}")
    if bag is not None and bag.exists():
        raise BagError(f"{bag} exists already: choose another folder")
    if bag is not None and attach and level != "telemetry":
        raise BagError(
            f"--level {level}: images of running nodes are not written: choose --level telemetry, and record the "
            f"images with `ros2 bag record {namespace}/camera/image_raw`"
        )
    if video is not None:
        check_path(video)
    started = time.monotonic()
    try:
        if used_engine == "local":
            run = _run_without_ros(sim, network, scenario)
        else:
            run = _run_on_nodes(sim, network, scenario, namespace, attach=attach, wait=wait)
        whose = "attached" if attach else str(network)
        translate = None if attach or not (bag or video) else translation_of(network, sim)
        if bag is not None:
            write_bag(bag, namespace, sim, run, {"driver": whose}, level, translate=translate)
        if video is not None:
            say(f"rendering {video}")
            # The images went to the driver alone; the same commands show them again.
            title, frames = f"{sim}, {Path(whose).name}", resimulate(sim, run)
            write_video(video, title, way, frames, run.commands, run.conditions, translate)
    except KeyboardInterrupt:
        raise Interrupted(f"the bag is in {bag}" if bag is not None and bag.exists() else "") from None
    wall = time.monotonic() - started
    habits = command_habits(
        np.array([one.steering for one in run.commands]), np.array([one.vehicle.speed for one in run.observations])
    )
    is_autopilot = network == AUTOPILOT and not attach
    if is_autopilot or not way.turns_count:  # it sees no image; on a straight road, good drivers steer the same
        habits = tuple(habit for habit in habits if habit.kind != "constant")
    document: dict[str, Any] = {
        "simulator": sim,
        "driver": whose,
        "road_id": way.road_id,
        "seed": chosen,
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
        for line in drive_in_words(document, way):
            print(line)
        for habit in habits:
            print(warning(whose, habit))

    unmet = [f"{whose} fails on the road"] if fail_on == "failure" and run.outcome.is_failure else []
    following = ds_command("test", "dave2" if attach or is_autopilot else whose)
    error = run.outcome.is_error
    return Result(document=document, show=show, error=error, unmet=unmet, next=following)


serve_app = typer.Typer()


@serve_app.command("donkey")
def serve_donkey_command(
    sim: options.Simulator = SimulatorName("donkey"),
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 for any free one.")] = 9091,
    host: Annotated[
        str, typer.Option(help="Address to listen on. Clients are not authenticated: keep to this machine.")
    ] = "127.0.0.1",
    road: Annotated[
        Path | None, typer.Option(help="JSON list of roads, driven one after the other; a random one if left out.")
    ] = None,
    seed: options.Seed = 0,
    max_angle: options.MaxAngle = 270,
    lane: options.Lane = None,
    conditions: Annotated[
        str,
        typer.Option(help="Operating conditions, such as line_contrast=0.4.", autocompletion=options.complete_value),
    ] = "",
) -> None:
    """Serve a simulator to clients of the Donkey simulator, such as gym-donkeycar's environments.

    The simulator makes one frame for each control, as fast as the client sends them. The address is printed when
    clients can connect. Serves until it is stopped.

    Example: ds serve donkey --sim panda --port 9091
    """
    from ds_sim.donkey_protocol.server import DonkeyServer

    roads = [one_road(None, seed, max_angle, lane)] if road is None else roads_of(road, lane)
    chosen_conditions = parse_conditions(conditions)
    server = DonkeyServer(sim, [Scenario(one, chosen_conditions, seed=seed) for one in roads])

    def listening(chosen: int) -> None:
        print(f"serving {sim} on {host}:{chosen}", flush=True)
        say_next(ds_command("drive", "--sim", sim, "--driver", "autopilot"))

    asyncio.run(server.serve(host, port, listening))
