"""Measures on each road the level of one factor at which a driver first fails, as far as it can be judged by that."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import shapely

from ds_driver.closed_loop.simulation import AUTOPILOT, Drive, run_drive
from ds_driver.networks.pilot import DriverError
from ds_orchestrator.sensitivity.bisection import Bracket, first_failure
from ds_orchestrator.sensitivity.factors import LEVELS, Factor
from ds_orchestrator.siblings.kept_drives import run_kept
from ds_road import Road, generate
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.gates.gate import gate_of
from ds_sim.oracle import OracleLimits
from ds_sim.registry import spec_of

SEGMENTS = 4
"""Segments of a road, 25 m each, of the six of a generated one: 100 m, on which the car takes up speed on a straight
segment and then takes three bends. Chosen: a drive takes two thirds of the time, and a driver that cannot see fails in
its first bends; one that swings up may need more."""
MOST_SEGMENTS = 6
"""Segments of a generated road: the spline goes from its second control point to the last but one."""
MAX_ANGLE = 270
"""Largest angle of the roads before they are cut, degrees: that of the training roads (paper 4.2.2)."""
CANDIDATES = 3
"""Roads tried for each one needed; chosen: a driver that completes less than a third of them needs no conditions to
fail."""

Fails = Callable[[str, int, Conditions], bool]
"""Whether a driver (`autopilot` or `TESTED`) fails on the road of a number under conditions; `GATE`: whether no driver
can be judged there, as the autopilot fails or the lines are invisible (`ds_sim.gates`)."""
TESTED, GATE = "tested", "gate"


@dataclass(frozen=True, kw_only=True)
class RoadResult:
    """One factor on one road.

    Attributes:
        feasible: highest level by which the driver can be judged: the autopilot completes it, and the lines are visible
            where the driver would fail.
        completes: highest level that the driver completes below `fails`.
        fails: next level, at which it fails; None if it completes `feasible`.
    """

    feasible: int
    completes: int
    fails: int | None


@dataclass(frozen=True, kw_only=True)
class Task:
    """One factor on one simulator, or the choice of a simulator's roads; what a worker process does at a time.

    Attributes:
        simulator: name of the simulator.
        driver: name of the driver.
        factor: what is varied; None to choose roads.
        roads: (road, seed of its runs); candidates where roads are chosen.
        needed: number of roads to choose.
        folder: of the kept drives, or None.
    """

    simulator: str
    driver: str
    factor: Factor | None
    roads: tuple[tuple[Road, int], ...]
    needed: int = 0
    folder: Path | None = None


@dataclass(frozen=True, kw_only=True)
class TaskResult:
    """What a task found.

    Attributes:
        results: one per road, in order; empty where roads were chosen, or after an error.
        chosen: numbers of the roads that driver and autopilot complete under default conditions.
        error: one line if a drive ended in an error, which is no result; else "".
    """

    results: tuple[RoadResult, ...] = ()
    chosen: tuple[int, ...] = ()
    error: str = ""


def candidate_roads(count: int, seed: int, *, segments: int = SEGMENTS) -> list[tuple[Road, int]]:
    """Generate candidates for a number of roads, with the seeds of their runs; fewer roads have the same first ones.

    Left out are roads on which a car that never steers stays in its lane: they test nothing.

    Args:
        count: number of roads needed.
        seed: of the roads, and of the runs on the first one.
        segments: segments of 25 m that are kept of each random road, 2 to `MOST_SEGMENTS`.
    """
    rng = np.random.default_rng(seed)
    roads: list[tuple[Road, int]] = []
    while len(roads) < CANDIDATES * count:
        road = Road(generate(rng, max_angle=MAX_ANGLE).control_points[: segments + 3])
        if road.validity.valid and _needs_steering(road):
            roads.append((road, (seed + len(roads)) % 2**32))
    return roads


def _needs_steering(road: Road) -> bool:
    """Whether a straight line from the start of the lane leaves it."""
    lane = road.lane_centre
    length = float(np.hypot(*np.diff(lane, axis=0).T).sum())
    ahead = (lane[1] - lane[0]) / np.hypot(*(lane[1] - lane[0]))
    straight = lane[0] + np.outer(np.arange(0.0, length - OracleLimits().finish_margin, 1.0), ahead)
    apart = shapely.distance(shapely.points(straight), shapely.LineString(lane))
    return bool(np.max(apart) > road.lane_width / 2)


def choose_roads(count: int, needed: int, fails: Fails) -> tuple[int, ...]:
    """Numbers of the first roads that the driver and the autopilot complete under default conditions."""
    chosen: list[int] = []
    for road in range(count):
        if len(chosen) < needed and not fails(AUTOPILOT, road, DEFAULT) and not fails(TESTED, road, DEFAULT):
            chosen.append(road)
    return tuple(chosen)


def measure(factor: Factor, roads: int, fails: Fails) -> tuple[RoadResult, ...]:
    """Bisect a factor on each road.

    Where a factor moves the vehicle, levels that the autopilot does not complete are not driven. The autopilot sees no
    picture: where a factor changes pictures alone, its drive is the one that it completed under default conditions, but
    the lines may be invisible; that is measured at the level at which the driver fails, and below it if they are.

    Args:
        factor: what is varied.
        roads: number of roads, all of which autopilot and driver complete under default conditions.
        fails: drives.
    """
    results = []
    near: dict[str, Bracket] = {}

    def bracket(driver: str, road: int, highest: int) -> Bracket:
        near[driver] = first_failure(
            lambda level: fails(driver, road, factor.conditions(level)), highest, near.get(driver)
        )
        return near[driver]

    for road in range(roads):
        feasible = bracket(AUTOPILOT, road, LEVELS).completes if factor.moves_vehicle else LEVELS
        found = bracket(TESTED, road, feasible)
        if not factor.moves_vehicle and found.fails is not None and fails(GATE, road, factor.conditions(found.fails)):
            feasible = bracket(GATE, road, found.completes).completes
            found = Bracket(feasible, None)
        results.append(RoadResult(feasible=feasible, completes=found.completes, fails=found.fails))
    return tuple(results)


def do(task: Task) -> TaskResult:
    """Do a task in this process; drives that ended in an error are no results."""
    fails = partial(_fails, task)
    try:
        if task.factor is None:
            return TaskResult(chosen=choose_roads(len(task.roads), task.needed, fails))
        return TaskResult(results=measure(task.factor, len(task.roads), fails))
    except DriverError as error:
        return TaskResult(error=str(error))


def _fails(task: Task, driver: str, number: int, conditions: Conditions) -> bool:
    road, seed = task.roads[number]
    named = task.driver if driver == TESTED else AUTOPILOT
    drive = Drive(task.simulator, named, road, seed, conditions, probed=driver == GATE)
    folder = None if task.folder is None else task.folder / driver
    run = run_drive(drive) if folder is None else run_kept(folder, drive)
    if not run.outcome.is_verdict:
        message = f": {run.message}" if run.message else ""
        raise DriverError(f"{task.simulator}, road {road.road_id}, seed {seed}: {run.outcome.name.lower()}{message}")
    return run.outcome.is_failure if driver != GATE else not gate_of(run).is_valid


def tasks_of(
    driver: str, roads: Mapping[str, Sequence[tuple[Road, int]]], factors: Sequence[Factor], folder: Path | None
) -> list[Task]:
    """Every factor on every simulator that realises it, in the order of the factors."""
    return [
        Task(simulator=name, driver=driver, factor=factor, roads=tuple(of), folder=folder)
        for factor in factors
        for name, of in roads.items()
        if is_applicable(factor, spec_of(name).conditions)
    ]


def is_applicable(factor: Factor, realised: Sequence[str]) -> bool:
    """Whether a simulator that realises some conditions realises a factor."""
    return set(factor.conditions(LEVELS).changed) <= set(realised)
