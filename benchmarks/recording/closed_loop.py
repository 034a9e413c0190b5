# SPDX-License-Identifier: Apache-2.0
"""Is a recording's sibling the simulator that was recorded? Verdicts of networks on both, on the same roads.

`python -m benchmarks.recording.closed_loop --out closed` records `ROADS` roads on `donkey`, each once, by a pilot with
a shaky hand, as tubs of images and commands; fits the twin to them; and drives networks under conditions on `donkey`,
on the siblings made from each recording, and on `bullet`, `softbody` and `panda`. `true poses` is made from the true
poses, track and camera, so that the sibling alone is measured; `found` from what `ds recording locate` finds in images
and commands with the true camera, as after `ds recording calibrate`.

Fixed before the first drive: roads, hand, networks, conditions, limits of the sibling, statistics.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.recording.drives import floor_camera, write_tub

from ds_cli.output import ScreenProgress, say
from ds_driver.control.autopilot import Autopilot
from ds_driver.data.recordings import Reading
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import Callbacks, drive_tests
from ds_orchestrator.store.model import Test
from ds_recording.floor_camera import read_camera, write_camera
from ds_recording.locate import located_of
from ds_recording.located import COLUMNS, write_located
from ds_recording.recording import read_views
from ds_recording.sibling.recorded_drive import read_drive, sections
from ds_recording.track import HEADER
from ds_road import Road
from ds_road.generation import generate
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.oracle import LaneTracker
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.simulator import FRAME_TIME, Command, Outcome
from ds_studies.same_roads import driven_road
from ds_twin_donkey.car_files import document_of, write_parameters
from ds_twin_donkey.fit import FitSettings, fit
from ds_twin_donkey.logs import read_log
from ds_twin_donkey.parameters import SCALE

ROADS, SEED = 12, 3900
LANE = 4.0 / SCALE
"""Width of a lane on the floor, m."""
HAND = (0.15, 0.25)
"""Share by which the hand's aim returns in a frame, and standard deviation of its steps, m across the lane."""
NETWORKS = ("dave2_short", "dave2", "epoch", "convolutional")
CONDITIONS = {
    "as it is": DEFAULT,
    "delay 0.1 s": Conditions(command_delay=0.1),
    "pull to the left": Conditions(tyre_pull=0.03),
    "dark": Conditions(illuminance=50.0),
}
MADE = ("true poses", "found")
OTHERS = ("donkey", "bullet", "softbody", "panda")


def record(road: Road, seed: int, folder: Path) -> None:
    """Drive a road on `donkey` with a shaky hand, and write the tub and what `ds recording locate` would find in it."""
    rng = np.random.default_rng(seed)
    simulator = make_simulator("donkey")
    spec = simulator.spec
    pilot, tracker = Autopilot(spec.autopilot), LaneTracker(road.points)
    observation = simulator.load(road, seed=seed)
    aim, images, states, commands = 0.0, [], [], []
    while observation.outcome is Outcome.RUNNING:
        aim += -HAND[0] * aim + HAND[1] * rng.normal()
        steered = pilot.command(observation.lane.preview_lateral_position + aim, observation.vehicle.speed)
        command = Command(float(np.clip(round(steered.steering, 1), -1.0, 1.0)), steered.throttle)
        images.append(observation.image)
        states.append(observation.vehicle)
        commands.append(command)
        observation = simulator.step(command)
    simulator.close()
    if observation.outcome is not Outcome.COMPLETED:
        raise SystemExit(f"road {seed}: the hand ended {observation.outcome.name}")
    write_tub(
        folder / "tub", [(FRAME_TIME * k, *pair, {}) for k, pair in enumerate(zip(images, commands, strict=True))]
    )
    located = []
    for k, command in enumerate(commands):
        state = states[max(k - spec.camera.latency, 0)]  # what the image shows
        lateral, along = tracker.update(state.x, state.y)
        place = np.array([state.x, state.y, state.yaw, along, lateral]) / [SCALE, SCALE, 1.0, SCALE, SCALE]
        motion = (0.0, state.speed / SCALE, state.yaw_rate, 0.0, 0.0)
        located.append((k, FRAME_TIME * k, *place, *motion, command.steering, command.throttle))
    lines = [",".join(COLUMNS), *(",".join(f"{value:.9g}" for value in row) for row in located)]
    (folder / "located.csv").write_text("\n".join(lines) + "\n")
    track = [f"{x / SCALE:.6f},{y / SCALE:.6f},{LANE},{LANE}" for x, y in road.points.tolist()]
    (folder / "track.csv").write_text("\n".join([HEADER, *track]) + "\n")
    write_camera(folder / "camera.yaml", floor_camera(spec.camera).scaled(1.0 / SCALE))
    (folder / "recording.json").write_text(json.dumps({"source": "tub", "lane_width_m": LANE}))


def main() -> None:
    """Record, fit, drive, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    out = arguments.out
    folders = [out / f"road{k:02d}" for k in range(ROADS)]
    for k, folder in enumerate(folders):
        if not (folder / "recording.json").exists():
            record(generate(np.random.default_rng(SEED + k), max_angle=270), SEED + k, folder)
            say(f"recorded {folder}")
        if not (folder / "found/recording.json").exists():
            views = read_views(folder / "tub", Reading(whole=True))
            place = located_of(views, read_camera(folder / "camera.yaml"), LANE)[0]
            write_located(folder / "found", replace(place, about=place.about | {"source": "../tub"}))
            say(f"located {len(place.table)} of {len(views.frames)} images of {folder}")
    siblings = {name: folders if name == MADE[0] else [folder / "found" for folder in folders] for name in MADE}
    roads: dict[str, list[Road]] = {}
    for name, made in siblings.items():
        car = out / f"car of {name}.yaml"
        if not car.exists():
            logs = [read_log(folder) for folder in made]
            fitted = fit([drive for log in logs for drive in log.drives], None, FitSettings(), ScreenProgress())
            write_parameters(car, document_of(fitted, logs))
        for folder in made:
            (folder / "simulator.yaml").write_text(f"car: {car.resolve()}\ncrop_top: 40\n")
        drives = [read_drive(folder) for folder in made]
        roads[name] = [sections(one, math.floor(one.lane.length) - 4.0, 1000.0)[0] for one in drives]
    rows = []
    for network in NETWORKS:
        driver = DriverName.parse(f"{network}@onnx")
        for label, conditions in CONDITIONS.items():
            say(f"{network}, {label}")
            verdicts: dict[str, list[str]] = {}
            for name in (*MADE, *OTHERS):
                names = [
                    SimulatorName(f"recording@{siblings[name][k]}" if name in MADE else name) for k in range(ROADS)
                ]
                tests = [
                    Test(f"{k:02d}", Scenario(road, conditions, seed=SEED + k))
                    for k, road in enumerate(roads.get(name, roads[MADE[0]]))
                ]
                work: dict[SimulatorName, list[Test]] = {}
                for of, test in zip(names, tests, strict=True):
                    work.setdefault(of, []).append(test)
                settings = DriveSettings(siblings=tuple(work), driver=driver, gates="none", workers=arguments.workers)
                place = out / "drives" / network / label.replace(" ", "_") / name.replace(" ", "_")
                driven = drive_tests(settings, work, place, Callbacks())
                runs = [driven_road(driven, test, of) for of, test in zip(names, tests, strict=True)]
                verdicts[name] = ["?" if run is None else "F" if run.outcome.is_failure else "." for run in runs]
                say(f"  {name:10} {''.join(verdicts[name])}")
                for k, run in enumerate(runs):
                    worst = "" if run is None else round(run.max_lateral_position, 3)
                    rows.append((network, label, k, name, verdicts[name][k], worst))
    lines = ["network,conditions,road,simulator,verdict,max_lateral_m", *(",".join(map(str, row)) for row in rows)]
    (out / "verdicts.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
