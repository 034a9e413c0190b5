"""How well a driver drives: its success on roads it has not seen, and its error on labelled images (paper 4.2.2)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ds_driver.collection import DIRECTIONS
from ds_driver.dataset import DatasetError, Sample, check_equal, decode, read_samples
from ds_driver.driving import Drive, drive_all
from ds_driver.network_driver import NetworkDriver
from ds_driver.preprocessing import Crop
from ds_driver.workers import in_workers
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
) -> dict[str, dict[str, float]]:
    """Share of the roads that a driver completes on each simulator, by direction, without ROS.

    Args:
        driver: `autopilot`, a shipped network, or a weights file.
        simulators: names.
        roads: to drive, each in both directions.
        seed: of the first road's runs; those of the next one have one more.
        progress: told after every drive.

    Returns:
        Simulator -> `forward` and `reverse` -> share in [0, 1].
    """
    drives = [
        Drive(name, driver, road if way == "forward" else road.reversed(), seed + i)
        for name in simulators
        for way in DIRECTIONS
        for i, road in enumerate(roads)
    ]
    completed: dict[str, dict[str, int]] = {name: dict.fromkeys(DIRECTIONS, 0) for name in simulators}
    for done, (drive, run) in enumerate(zip(drives, drive_all(drives), strict=True), start=1):
        way = DIRECTIONS[(done - 1) // len(roads) % 2]
        completed[drive.simulator][way] += run.outcome is Outcome.COMPLETED
        progress(
            done,
            len(drives),
            f"{drive.simulator} {roads[(done - 1) % len(roads)].road_id} {way}: {run.outcome.name.lower()}",
        )
    return {name: {way: n / len(roads) for way, n in counts.items()} for name, counts in completed.items()}


def steering_errors(driver: str, data: Path, crops: dict[str, Crop]) -> dict[str, np.ndarray]:
    """What a network answers to labelled images, less the label, by simulator (paper 4.2.3, 4.4).

    Args:
        driver: a shipped network, or a weights file.
        data: folder of a data set.
        crops: rows cut off per simulator.

    Returns:
        Simulator -> (n,) float64 errors of steering, in the order of the data set.

    Raises:
        DatasetError: the data set cannot be used.
    """
    samples = read_samples(data)
    check_equal(samples)
    strange = {s.simulator for s in samples} - set(crops)
    if strange:
        raise DatasetError(f"no crop is known for {', '.join(sorted(strange))}: name the simulators of the data set")
    parts = {name: [s for s in samples if s.simulator == name] for name in sorted({s.simulator for s in samples})}
    jobs = [(driver, crops[name], part) for name, part in parts.items()]
    return dict(zip(parts, in_workers(_errors, jobs), strict=True))


def _errors(job: tuple[str, Crop, list[Sample]]) -> np.ndarray:
    name, crop, samples = job
    network = NetworkDriver(name)
    return np.array([network.steering(decode(s.jpeg), crop) - s.steering for s in samples])
