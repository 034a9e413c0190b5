"""Influence of the physics' substep: fitness of the autopilot with the nominal substep and with finer ones.

`python -m benchmarks.convergence [--roads 20] [--finer 2] [--sims bullet,softbody,panda,donkey]` prints one row per
simulator, as Markdown. Every road is driven twice, in this process, without camera or ROS.
`--training` drives the paper's training set (4.2.2: 25 roads in both directions) instead and counts completed drives.
"""

from __future__ import annotations

import argparse

import numpy as np
from benchmarks.headless import Car, cars, drive

from ds_driver.data.collection import CollectionPlan, roads_both_ways
from ds_road import Road, generate
from ds_sim.simulator import Outcome

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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--roads", type=int, default=20)
    parser.add_argument("--finer", type=int, default=2)
    parser.add_argument("--sims", default=",".join(cars()))
    parser.add_argument("--training", action="store_true")
    arguments = parser.parse_args()
    chosen = {name: cars()[name] for name in arguments.sims.split(",")}
    if arguments.training:
        print_training(chosen)
        return
    roads = random_roads(arguments.roads)
    print("| simulator | substep, ms | halved: change of fitness, mm (median, max) | distance of paths, mm (max) |")
    print("|---|---|---|---|")
    for name, car in chosen.items():
        shifts, distances = (1e3 * np.array(values) for values in fitness_shift(car, roads, arguments.finer))
        apart = distances.max()
        print(
            f"| {name} | {1e3 * car.substep:.3g} | {np.median(shifts):.1f}, {shifts.max():.1f} | {apart:.0f} |",
            flush=True,
        )


def print_training(chosen: dict[str, Car]) -> None:
    """Print one row per simulator: results of the autopilot on the training set, and its top speed."""
    plan = CollectionPlan()
    trained_on = roads_both_ways(plan.roads, plan.seed, max_angle=plan.max_angle)
    roads = [way for road in trained_on for way in (road, road.reversed())]
    print("| simulator | drives | completed | smallest lateral distance, m | highest speed, km/h |")
    print("|---|---|---|---|---|")
    for name, car in chosen.items():
        vehicle = car.make(1)
        drives = [drive(car, vehicle, road) for road in roads]
        vehicle.close()
        done = sum(d.outcome is Outcome.COMPLETED for d in drives)
        speed = 3.6 * max(float(d.path[:, 3].max()) for d in drives)
        fitness = min(d.fitness for d in drives)
        print(f"| {name} | {len(drives)} | {done} | {fitness:.2f} | {speed:.1f} |", flush=True)


if __name__ == "__main__":
    main()
