"""Success rate of a driver on roads not seen in training (paper 4.2.2)."""

from __future__ import annotations

import numpy as np

from ds_driver.closed_loop.drive_request import DriveRequest
from ds_driver.closed_loop.simulation import drive_all
from ds_driver.data.collection import DIRECTIONS
from ds_driver.networks.pilot import DriverError
from ds_driver.processes import Progress
from ds_road import Road, generate
from ds_sim.simulator import Outcome


def unseen_roads(count: int, seed: int, *, max_angle: int = 270) -> list[Road]:
    """Generate random roads as in the paper's test set (4.2.2: 25 roads, maximum angle 270 degrees)."""
    rng = np.random.default_rng(seed)
    return [generate(rng, max_angle=max_angle) for _ in range(count)]


def success_rates(
    driver: str, simulators: list[str], roads: list[Road], seed: int, progress: Progress
) -> dict[str, dict[str, float]]:
    """Share of the roads that a driver completes on each simulator, by direction, without ROS.

    Each road is driven in both directions; `seed` is that of the runs on the first road, and increases by one per road.

    Returns:
        Simulator -> `forward` and `reverse` -> share in [0, 1].

    Raises:
        DriverError: a drive ended in an error, so that there is no success rate.
    """
    keys = [(name, way, i) for name in simulators for way in DIRECTIONS for i in range(len(roads))]
    drives = [
        DriveRequest(name, driver, roads[i] if way == "forward" else roads[i].reversed(), seed + i)
        for name, way, i in keys
    ]
    completed: dict[str, dict[str, int]] = {name: dict.fromkeys(DIRECTIONS, 0) for name in simulators}
    for done, ((name, way, i), drive, run) in enumerate(zip(keys, drives, drive_all(drives), strict=True), start=1):
        if not run.outcome.is_verdict:
            raise DriverError(
                f"{drive.simulator}, road {drive.road.road_id}, seed {drive.seed}: {run.outcome.name.lower()}"
                f"{': ' if run.message else ''}{run.message}: "
                f"an error says nothing about {driver}: fix it and run the assessment again"
            )
        completed[name][way] += run.outcome is Outcome.COMPLETED
        progress(done, len(drives), f"{name} {roads[i].road_id} {way}: {run.outcome.name.lower()}")
    return {name: {way: n / len(roads) for way, n in counts.items()} for name, counts in completed.items()}
