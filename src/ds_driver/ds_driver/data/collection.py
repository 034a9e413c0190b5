# SPDX-License-Identifier: Apache-2.0
"""Collects driving data labelled by the autopilot (paper 3.2.1, 4.2.2): each road in both directions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np

from ds_base.bounded_file import read_words
from ds_base.folder_files import write_whole
from ds_base.installation import ds_command
from ds_base.processes import map_in_processes
from ds_base.progress import Progress
from ds_driver.control.autopilot import Autopilot
from ds_driver.data.dataset import DatasetError, drive_path, write_drive
from ds_road import Road, RoadError, generate, mutate, read_raw_roads, road_from_json
from ds_sim.camera.encodings import jpeg
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.conditions.text import format_conditions, parse_conditions
from ds_sim.registry import SimulatorName, simulator_of_process, spec_of
from ds_sim.simulator import Command, Outcome

DIRECTIONS = ("forward", "reverse")


@dataclass(frozen=True, kw_only=True)
class CollectionPlan:
    """Settings of a collection.

    Attributes:
        roads: number of roads, each driven in both directions (paper 4.2.2: 25).
        seed: of roads and disturbances.
        max_angle: largest angle of random roads, degrees (paper 4.2.2: 270).
        disturbance: largest steering in [0, 1] that is added to the autopilot's but not to the label; 0 in the paper.
            With 0.5 a network learns to return to its lane and hardly ever fails.
        every: keep every n-th frame.
    """

    roads: int = 25
    seed: int = 1
    max_angle: int = 270
    disturbance: float = 0.0
    every: int = 1


def unseen_roads(count: int, seed: int, *, max_angle: int = 270) -> list[Road]:
    """Generate random roads as in the paper's test set (4.2.2: 25 roads, maximum angle 270 degrees)."""
    rng = np.random.default_rng(seed)
    return [generate(rng, max_angle=max_angle) for _ in range(count)]


def roads_both_ways(count: int, seed: int, *, max_angle: int = 270) -> list[Road]:
    """Generate random roads that are valid in both directions; the same seed gives the same roads."""
    rng = np.random.default_rng(seed)
    roads: list[Road] = []
    while len(roads) < count:
        road = generate(rng, max_angle=max_angle)
        # The edge of a sharp bend is built sample by sample, so it may fold in one direction only.
        if road.reversed().validity.valid:
            roads.append(road)
    return roads


class GivenRoad(NamedTuple):
    """Road to drive under conditions; `family`, which a split keeps together, is the id of what it is a mutant of."""

    road: Road
    family: str
    conditions: Conditions = DEFAULT

    @property
    def name(self) -> str:
        """Name of its files: the road's id, and a checksum of the conditions if there are any."""
        text = format_conditions(self.conditions)
        return self.road.road_id + (f"+{crc32(text.encode()):08x}" if text else "")


def given_roads(file: Path, *, mutants: int, seed: int) -> list[GivenRoad]:
    """Read roads, as `ds campaign roads --failed` writes them, each followed by mutants, made as the search does.

    They are under the conditions of their tests, none twice under the same. A file without roads is a DatasetError, an
    invalid road or one without valid mutants a RoadError.
    """
    roads_by_id: dict[str, GivenRoad] = {}
    for index, raw in enumerate(read_raw_roads(file)):
        text = raw.get("conditions", "") if isinstance(raw, dict) else ""
        if not isinstance(text, str):
            raise DatasetError(f"{file}: road {index}: its conditions are not a text, expected such as visibility=40")
        try:
            road, rng = road_from_json(raw), np.random.default_rng([seed, index])
            if not road.validity.valid:
                raise RoadError(road.validity.reason)
            around = [mutate(road, rng, maxitwo_compatible=road.maxitwo_compatible) for _ in range(mutants)]
        except RoadError as error:
            raise RoadError(f"{file}: road {index}: {error}") from None
        for one in (GivenRoad(r, road.road_id, parse_conditions(text)) for r in (road, *around)):
            roads_by_id.setdefault(one.name, one)
    if not roads_by_id:
        command = ds_command("campaign", "roads", "DIR", "--failed", "--out", file)
        raise DatasetError(f"{file} holds no road: expected those of `{command}`")
    return list(roads_by_id.values())


class _Job(NamedTuple):
    path: Path
    simulator: SimulatorName
    given: GivenRoad
    direction: str
    number: int

    @property
    def road(self) -> Road:
        return self.given.road if self.direction == "forward" else self.given.road.reversed()


def collect(
    plan: CollectionPlan,
    simulators: list[SimulatorName],
    folder: Path,
    progress: Progress,
    roads: Sequence[GivenRoad] | None = None,
) -> None:
    """Drive every road, and write the folder of a data set; skip drives whose file exists, so a stopped one resumes.

    Given `roads` are driven instead of random ones; a direction in which one is not valid is left out, and so is a
    simulator that cannot realise its conditions. `progress` counts the drives.

    Raises:
        ds_driver.data.dataset.DatasetError: the folder holds drives of another plan.
    """
    names = {} if roads is None else {"given": [one.name for one in roads]}
    file, text = folder / "plan.json", json.dumps({**asdict(plan), **names}, indent=1) + "\n"
    if not file.exists():
        write_whole(file, text)
    elif read_words(file) != text:
        raise DatasetError(f"{folder} holds drives of another plan (see plan.json): choose another --out")
    if roads is None:
        roads = [GivenRoad(r, r.road_id) for r in roads_both_ways(plan.roads, plan.seed, max_angle=plan.max_angle)]
    jobs = [
        job
        for index, one in enumerate(roads)
        for direction in DIRECTIONS
        for name in simulators
        if (job := _Job(drive_path(folder, name, one.name, direction), name, one, direction, index)).road.validity.valid
        and set(one.conditions.changed) <= set(spec_of(name).conditions)
    ]
    missing = [job for job in jobs if not job.path.exists()]
    collected = len(jobs) - len(missing)
    progress.start(len(jobs))
    if collected:
        progress.advance(collected, f"{collected} drives are there already")
    for line in map_in_processes(partial(_collect, plan), missing):
        progress.advance(line=line)


def _collect(plan: CollectionPlan, job: _Job) -> str:
    """Drive one road with disturbed commands, and write its frames, labelled with the undisturbed ones."""
    simulator, conditions = simulator_of_process(job.simulator), job.given.conditions
    rng = np.random.default_rng([plan.seed, job.number, job.direction == "reverse", crc32(job.simulator.encode())])
    autopilot = Autopilot(simulator.spec.autopilot)
    observation = simulator.load(job.road, seed=int(rng.integers(2**31)), conditions=conditions)
    push, rows = 0.0, list[dict[str, object]]()
    while observation.outcome is Outcome.RUNNING:
        label = autopilot.command(observation.lane.preview_lateral_position, observation.vehicle.speed)
        if observation.step % plan.every == 0:
            rows.append(
                {
                    "image": jpeg(observation.image),
                    "steering": label.steering,
                    "throttle": label.throttle,
                    "speed": observation.vehicle.speed,
                    "lateral_position": observation.lane.lateral_position,
                    "step": observation.step,
                    "simulator": job.simulator,
                    "road_id": job.given.family,
                    "direction": job.direction,
                }
            )
        # A push of random strength, about every two seconds for about half a second.
        if rng.random() < 0.025:
            push = float(rng.uniform(-plan.disturbance, plan.disturbance))
        elif rng.random() < 0.1:
            push = 0.0
        near_edge = observation.lane.lateral_distance < 0.8
        steering = label.steering + (0.0 if near_edge else push)
        observation = simulator.step(Command(min(max(steering, -1.0), 1.0), label.throttle))
    if observation.outcome is not Outcome.COMPLETED and not conditions.is_default:
        rows = []  # where the autopilot fails, no network can do what it does
    write_drive(job.path, rows)
    outcome = observation.outcome.name.lower()
    return f"{job.simulator} {job.given.name} {job.direction}: {outcome}, {len(rows)} images"
