"""Labelled driving data from the autopilot (paper 3.2.1, 4.2.2): every road in both directions on every simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import numpy as np

from ds_driver.control import Autopilot
from ds_driver.dataset import drive_path, encode, write_drive
from ds_road import Road, generate
from ds_sim.registry import make_simulator
from ds_sim.simulator import Command, Outcome, Simulator

Progress = Callable[[int, int, str], None]
"""Called with drives done, drives in all, and a line about the last one."""


@dataclass(frozen=True, kw_only=True)
class CollectionPlan:
    """What to collect.

    Attributes:
        roads: random roads, each driven in both directions (paper 4.2.2: 25).
        seed: of the roads and of the disturbances.
        max_angle: degrees, of the roads (paper 4.2.2: 270).
        disturbance: largest steering added to the autopilot's while its own stays the label, in [0, 1]; the paper has
            none. With 0.5 a network learns to come back to its lane and hardly ever fails.
        every: keep one frame of so many.
    """

    roads: int = 25
    seed: int = 1
    max_angle: int = 270
    disturbance: float = 0.0
    every: int = 1


def training_roads(plan: CollectionPlan) -> list[Road]:
    """The roads of a plan, valid in both directions; the same seed gives the same roads."""
    rng = np.random.default_rng(plan.seed)
    roads: list[Road] = []
    while len(roads) < plan.roads:
        road = generate(rng, max_angle=plan.max_angle)
        # The edge of a sharp bend may fold in one direction only, since it is drawn sample by sample.
        if road.reversed().validity.valid:
            roads.append(road)
    return roads


def collect(plan: CollectionPlan, simulators: list[str], folder: Path, progress: Progress) -> None:
    """Drive every road; a drive whose file exists is not driven again, so that a stopped collection goes on."""
    roads = training_roads(plan)
    drives = [
        (name, road if direction == "forward" else road.reversed(), road.road_id, direction, index)
        for index, road in enumerate(roads)
        for direction in ("forward", "reverse")
        for name in simulators
    ]
    made: dict[str, Simulator] = {}
    for done, (name, road, road_id, direction, index) in enumerate(drives, start=1):
        path = drive_path(folder, name, road_id, direction)
        if path.exists():
            progress(done, len(drives), f"{name} {road_id} {direction}: there already")
            continue
        simulator = made.setdefault(name, make_simulator(name))
        rng = np.random.default_rng([plan.seed, index, direction == "reverse", crc32(name.encode())])
        rows, outcome = _drive(simulator, road, rng, plan)
        for row in rows:
            row.update(simulator=name, road_id=road_id, direction=direction)
        write_drive(path, rows)
        progress(done, len(drives), f"{name} {road_id} {direction}: {outcome.name.lower()}, {len(rows)} images")
    for simulator in made.values():
        simulator.close()


def _drive(
    simulator: Simulator, road: Road, rng: np.random.Generator, plan: CollectionPlan
) -> tuple[list[dict[str, object]], Outcome]:
    """One drive: the autopilot's answer to every frame as label, its disturbed answer to the vehicle."""
    gains = simulator.spec.autopilot
    autopilot = Autopilot(gains)
    observation = simulator.load(road, seed=int(rng.integers(2**31)))
    push, rows = 0.0, []
    while observation.outcome is Outcome.RUNNING:
        label = autopilot.command(observation.lane.preview_lateral_position, observation.vehicle.speed)
        if observation.step % plan.every == 0:
            rows.append(
                {
                    "image": encode(observation.image),
                    "steering": label.steering,
                    "throttle": label.throttle,
                    "speed": observation.vehicle.speed,
                    "lateral_position": observation.lane.lateral_position,
                    "step": observation.step,
                }
            )
        # A push of random strength that comes about every second second and lasts about half of one.
        if rng.random() < 0.025:
            push = float(rng.uniform(-plan.disturbance, plan.disturbance))
        elif rng.random() < 0.1:
            push = 0.0
        near_edge = observation.lane.lateral_distance < 0.8
        steering = label.steering + (0.0 if near_edge else push)
        observation = simulator.step(Command(min(max(steering, -1.0), 1.0), label.throttle))
    return rows, observation.outcome
