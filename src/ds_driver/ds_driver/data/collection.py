"""Collects driving data labelled by the autopilot (paper 3.2.1, 4.2.2): each road in both directions."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np

from ds_driver.control.autopilot import Autopilot
from ds_driver.data.dataset import drive_path, keep_plan, write_drive
from ds_driver.processes import Progress, map_in_processes
from ds_road import Road, generate
from ds_sim.camera.encodings import jpeg
from ds_sim.registry import simulator_of_process
from ds_sim.simulator import Command, Outcome, Simulator

DIRECTIONS = ("forward", "reverse")


@dataclass(frozen=True, kw_only=True)
class CollectionPlan:
    """Settings of a collection.

    Attributes:
        roads: number of random roads, each driven in both directions (paper 4.2.2: 25).
        seed: seed of roads and disturbances.
        max_angle: largest angle of the roads, degrees (paper 4.2.2: 270).
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


class _Job(NamedTuple):
    path: Path
    simulator: str
    road: Road
    direction: str
    number: int


def collect(plan: CollectionPlan, simulators: list[str], folder: Path, progress: Progress) -> None:
    """Drive every road; skip drives whose file exists, so a stopped collection resumes.

    Raises:
        ds_driver.data.dataset.DatasetError: the folder holds drives of another plan.
    """
    keep_plan(folder, asdict(plan))
    jobs = [
        _Job(drive_path(folder, name, road.road_id, direction), name, road, direction, index)
        for index, road in enumerate(roads_both_ways(plan.roads, plan.seed, max_angle=plan.max_angle))
        for direction in DIRECTIONS
        for name in simulators
    ]
    missing = [job for job in jobs if not job.path.exists()]
    known = len(jobs) - len(missing)
    if known:
        progress(known, len(jobs), f"{known} drives are there already")
    for done, line in enumerate(map_in_processes(partial(_collect, plan), missing), start=known + 1):
        progress(done, len(jobs), line)


def _collect(plan: CollectionPlan, job: _Job) -> str:
    """Drive one road and write its file; return a line for the user."""
    simulator, road_id = simulator_of_process(job.simulator), job.road.road_id
    road = job.road if job.direction == "forward" else job.road.reversed()
    rng = np.random.default_rng([plan.seed, job.number, job.direction == "reverse", crc32(job.simulator.encode())])
    rows, outcome = _drive(simulator, road, rng, plan)
    for row in rows:
        row.update(simulator=job.simulator, road_id=road_id, direction=job.direction)
    write_drive(job.path, rows)
    return f"{job.simulator} {road_id} {job.direction}: {outcome.name.lower()}, {len(rows)} images"


def _drive(
    simulator: Simulator, road: Road, rng: np.random.Generator, plan: CollectionPlan
) -> tuple[list[dict[str, object]], Outcome]:
    """Drive a road with disturbed autopilot commands; label each frame with the undisturbed one."""
    gains = simulator.spec.autopilot
    autopilot = Autopilot(gains)
    observation = simulator.load(road, seed=int(rng.integers(2**31)))
    push, rows = 0.0, []
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
    return rows, observation.outcome
