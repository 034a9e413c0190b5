"""How well a driver drives: its success on roads it has not seen (paper 4.2.2, Table 1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ds_driver.driving import Drive, drive_all
from ds_road import Road, generate
from ds_sim.simulator import Outcome

Progress = Callable[[int, int, str], None]
"""Called with drives done, drives in all, and a line about the last one."""


def unseen_roads(count: int, seed: int, *, max_angle: int = 270) -> list[Road]:
    """Random roads as in the paper's test set (4.2.2: 25 roads, maximum angle 270)."""
    rng = np.random.default_rng(seed)
    return [generate(rng, max_angle=max_angle) for _ in range(count)]


def success_rates(
    driver: str, simulators: list[str], roads: list[Road], seed: int, progress: Progress
) -> dict[str, float]:
    """Share of the roads that a driver completes on each simulator, without ROS.

    Args:
        driver: `autopilot`, a shipped network, or a weights file.
        simulators: names.
        roads: to drive.
        seed: of the first road's run; the next one's is one more.
        progress: told after every drive.
    """
    drives = [Drive(name, driver, road, seed + i) for name in simulators for i, road in enumerate(roads)]
    completed = dict.fromkeys(simulators, 0)
    for done, (drive, run) in enumerate(zip(drives, drive_all(drives), strict=True), start=1):
        completed[drive.simulator] += run.outcome is Outcome.COMPLETED
        progress(
            done, len(drives), f"{drive.simulator} {run.road.road_id}: {run.outcome.name.lower()}, {run.steps} frames"
        )
    return {name: count / len(roads) for name, count in completed.items()}
