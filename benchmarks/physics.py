# SPDX-License-Identifier: Apache-2.0
"""Vehicles with the autopilot, but without camera and ROS, so that only the physics count.

`python -m benchmarks.physics convergence [--roads 20] [--finer 2]` drives every road with the nominal substep and with
finer ones, and prints one row per simulator, as Markdown, with the change of fitness; `commands [--out docs/images]`
draws where the commands that drive one vehicle along a road take the others. Both take
`--sims bullet,softbody,panda,donkey`.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ds_base.figures import draw_figure
from ds_driver.control.autopilot import Autopilot
from ds_road import Road, generate
from ds_sim.camera.encodings import png
from ds_sim.oracle import LaneTracker, Oracle
from ds_sim.parts import Vehicle
from ds_sim.registry import STANDARD, colours_of, spec_of
from ds_sim.simulator import FRAME_TIME, Command, Outcome
from ds_sim_bullet.parameters import BulletParameters
from ds_sim_bullet.vehicle import BulletVehicle
from ds_sim_panda.simulator import MultiBodyVehicle
from ds_sim_panda.vehicle.parameters import MultiBodyParameters
from ds_sim_softbody.parameters import SoftbodyParameters
from ds_sim_softbody.simulator import SoftbodyVehicle
from ds_twin_donkey import dynamics
from ds_twin_donkey.dynamics import CarModel
from ds_twin_donkey.parameters import DonkeyParameters
from ds_twin_donkey.simulator import DonkeyVehicle

COLOURS = {str(name): colour for name, colour in colours_of(STANDARD).items()}


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Result of one run.

    Attributes:
        fitness: smallest lateral distance, m (paper 3.3).
        outcome: how it ended.
        path: (steps + 1, 4) x, y, yaw, speed in road metres, including the start.
        commands: the autopilot's commands, one a step.
    """

    fitness: float
    outcome: Outcome
    path: NDArray[np.float64]
    commands: Sequence[Command]


@dataclass(frozen=True, kw_only=True)
class Car:
    """Vehicle of a simulator that can be made with finer substeps.

    Attributes:
        name: of the simulator, which has the autopilot's settings.
        make: makes a vehicle whose number of substeps is a multiple of the nominal one.
        substeps: nominal substeps of a frame.
    """

    name: str
    make: Callable[[int], Vehicle]
    substeps: int


def cars() -> dict[str, Car]:
    """The four vehicles, by name of their simulator."""
    every = (
        Car(name="bullet", make=_bullet, substeps=BulletParameters().substeps),
        Car(name="softbody", make=_softbody, substeps=SoftbodyParameters().frame_substeps),
        Car(name="panda", make=_panda, substeps=MultiBodyParameters().substeps),
        Car(name="donkey", make=_FinerDonkey, substeps=dynamics.SUBSTEPS),
    )
    return {car.name: car for car in every}


def drive(car: Car, vehicle: Vehicle, road: Road) -> Drive:
    """Let the autopilot drive a road until the run ends, as `ds_sim.road_simulator` would."""
    _start(vehicle, road)
    spec = spec_of(car.name)
    tracker, pilot, ahead = LaneTracker(road.lane_centre), Autopilot(spec.autopilot), spec.preview_distance
    oracle = Oracle(tracker.length)
    fitness, rows, outcome, commands = math.inf, [], Outcome.RUNNING, list[Command]()
    for step in range(10_000):
        s = vehicle.state()
        rows.append((s.x, s.y, s.yaw, s.speed))
        lateral, arc = tracker.update(s.x, s.y)
        distance = road.lane_width / 2 - abs(lateral)
        fitness = min(fitness, distance)
        outcome = oracle.judge(step=step, lateral_distance=distance, arc_length=arc)
        if outcome is not Outcome.RUNNING:
            break
        preview = tracker.lateral_position(s.x + ahead * math.cos(s.yaw), s.y + ahead * math.sin(s.yaw))
        commands.append(pilot.command(preview, s.speed))
        vehicle.advance(commands[-1])
    return Drive(fitness=fitness, outcome=outcome, path=np.array(rows), commands=commands)


def _start(vehicle: Vehicle, road: Road) -> None:
    lane = road.lane_centre
    ahead = lane[1] - lane[0]
    vehicle.reset(float(lane[0, 0]), float(lane[0, 1]), math.atan2(ahead[1], ahead[0]), np.random.default_rng(0))


def _bullet(finer: int) -> Vehicle:
    p = BulletParameters()
    return BulletVehicle(dataclasses.replace(p, substeps=finer * p.substeps))


def _softbody(finer: int) -> Vehicle:
    p = SoftbodyParameters()
    return SoftbodyVehicle(
        dataclasses.replace(p, frame_substeps=finer * p.frame_substeps, body_substeps=finer * p.body_substeps)
    )


def _panda(finer: int) -> Vehicle:
    p = MultiBodyParameters()
    return MultiBodyVehicle(dataclasses.replace(p, substeps=finer * p.substeps, stable_step=p.stable_step / finer))


class _FinerDonkey(DonkeyVehicle):
    """Twin with shorter substeps, which are not a parameter of the car."""

    def __init__(self, finer: int) -> None:
        super().__init__()
        self._model = CarModel(DonkeyParameters(), substeps=finer * dynamics.SUBSTEPS)


MAX_ANGLE = 270
"""Maximum angle of the roads, degrees (paper 4.2.2)."""


def random_roads(count: int) -> list[Road]:
    """Generate the first roads of seed 0."""
    rng = np.random.default_rng(0)
    return [generate(rng, max_angle=MAX_ANGLE) for _ in range(count)]


def fitness_shift(car: Car, roads: list[Road], finer: int) -> tuple[list[float], list[float]]:
    """Absolute change of fitness with `finer` times the substeps, and largest distance of the paths, per road, m."""
    coarse, fine = car.make(1), car.make(finer)
    shifts, distances = [], []
    for road in roads:
        one, other = drive(car, coarse, road), drive(car, fine, road)
        shifts.append(abs(one.fitness - other.fitness))
        frames = min(len(one.path), len(other.path))
        distances.append(float(np.hypot(*(one.path[:frames, :2] - other.path[:frames, :2]).T).max()))
    coarse.close()
    fine.close()
    return shifts, distances


def print_convergence(chosen: dict[str, Car], roads: list[Road], finer: int) -> None:
    """Print one row per simulator: how much finer substeps change fitness and paths."""
    print("| simulator | substep, ms | halved: change of fitness, mm (median, max) | distance of paths, mm (max) |")
    print("|---|---|---|---|")
    for name, car in chosen.items():
        shifts, distances = (1e3 * np.array(values) for values in fitness_shift(car, roads, finer))
        substep, median, most = 1e3 * FRAME_TIME / car.substeps, np.median(shifts), shifts.max()
        print(f"| {name} | {substep:.3g} | {median:.1f}, {most:.1f} | {distances.max():.0f} |", flush=True)


def draw_same_commands(chosen: dict[str, Car], road: Road, path: Path) -> None:
    """Draw the paths when the autopilot drives the first vehicle and the others replay its commands."""
    paths: dict[str, NDArray[np.float64]] = {}
    commands: Sequence[Command] = ()
    for name, car in chosen.items():
        vehicle = car.make(1)
        if not paths:
            driven = drive(car, vehicle, road)
            paths[name], commands = driven.path[:, :2], driven.commands
        else:
            _start(vehicle, road)
            places = []
            for command in commands:
                state = vehicle.state()
                places.append((state.x, state.y))
                vehicle.advance(command)
            paths[name] = np.array(places)
        vehicle.close()

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for line, style in ((road.left_edge, "-"), (road.points, "--"), (road.right_edge, "-")):
            axes.plot(*line.T, style, color="#aaaaaa")
        for name, way in paths.items():
            axes.plot(*way.T, color=COLOURS[name], label=name)
        axes.plot(*way[0], "o", color="black", label="start")
        axes.set(title=f"The same commands, which drive {next(iter(paths))} along the lane, on every vehicle")
        axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
        axes.legend()

    path.write_bytes(png(draw_figure(700, 760, draw)))


def main() -> None:
    """Print the table, or draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("convergence", "commands"))
    parser.add_argument("--roads", type=int, default=20)
    parser.add_argument("--finer", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    parser.add_argument("--sims", default=",".join(cars()))
    arguments = parser.parse_args()
    chosen = {name: cars()[name] for name in arguments.sims.split(",")}
    if arguments.what == "convergence":
        print_convergence(chosen, random_roads(arguments.roads), arguments.finer)
    else:
        draw_same_commands(chosen, random_roads(1)[0], arguments.out / "vehicles_commands.png")


if __name__ == "__main__":
    main()
