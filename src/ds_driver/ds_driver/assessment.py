"""How well a driver drives: its success on roads it has not seen (paper 4.2.2, Table 1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ds_driver.network_driver import NetworkDriver
from ds_driver.preprocessing import Crop
from ds_road import Road, generate
from ds_sim.registry import make_simulator
from ds_sim.simulator import Outcome

Progress = Callable[[str], None]


def unseen_roads(count: int, seed: int, *, max_angle: int = 270) -> list[Road]:
    """Random roads as in the paper's test set (4.2.2: 25 roads, maximum angle 270)."""
    rng = np.random.default_rng(seed)
    return [generate(rng, max_angle=max_angle) for _ in range(count)]


def success_rate(driver: NetworkDriver, simulator_name: str, roads: list[Road], seed: int, progress: Progress) -> float:
    """Share of the roads that a network completes on one simulator, in this process, without ROS."""
    simulator = make_simulator(simulator_name)
    crop = Crop(simulator.spec.crop_top, simulator.spec.crop_bottom)
    completed = 0
    for index, road in enumerate(roads):
        observation = simulator.load(road, seed=seed + index)
        while observation.outcome is Outcome.RUNNING:
            observation = simulator.step(driver.command(observation.image, observation.vehicle.speed, crop))
        completed += observation.outcome is Outcome.COMPLETED
        progress(f"{simulator_name} {road.road_id}: {observation.outcome.name.lower()} after {observation.step} frames")
    simulator.close()
    return completed / len(roads)
