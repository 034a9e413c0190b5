# SPDX-License-Identifier: Apache-2.0
"""Compares drives in bfloat16 with drives in single precision: the same network, roads and seeds.

`python -m benchmarks.precision --out precision` drives 200 random roads, in turn on bullet, softbody and donkey,
with `dave2` and with `dave2_short` (which fails often enough to show a difference), with the backends `openvino` and
`openvino-bf16` each: 800 drives without ROS. Every drive is kept; a stopped run continues there.
The roads are drawn as a search draws its first ones, with maximum angles of 100 to 300 degrees, from a seed that
nothing else uses.

The rule, fixed before the first drive: `openvino-bf16` is chosen for `ds_bringup/config/paper.yaml` only if, for each
of the two networks, over all 200 roads, the 95% interval of the paired difference of the failure rates (Bonett and
Price 2012, which has a width even without any difference) contains 0 and its half width is at most 5 percentage points.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import stats

from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.engine import DriveSettings
from ds_orchestrator.engines.drive_tests import DriveResults, drive_tests
from ds_orchestrator.store.model import Test
from ds_road import generate
from ds_sim.registry import STANDARD, SimulatorName
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

SEED = 8_130_013
"""Seed of the roads; used nowhere else. Road i is driven with seed SEED + i."""
ROADS = 200
NETWORKS = ("dave2", "dave2_short")
SINGLE = "openvino"
REDUCED = "openvino-bf16"
ANGLES = range(100, 301, 10)
"""Maximum angles, degrees (maxitwo; `ds_orchestrator.search.algorithms.SearchSettings`)."""
HALF_WIDTH = 5.0
"""Largest half width of the interval of the paired difference, percentage points."""


def work_of(count: int) -> dict[SimulatorName, list[Test]]:
    """Simulator -> its tests, in turn; fewer are the first ones of more."""
    rng, names = np.random.default_rng(SEED), list(STANDARD)
    work: dict[SimulatorName, list[Test]] = {name: [] for name in names}
    for number in range(count):
        name, road = names[number % len(names)], generate(rng, max_angle=int(rng.choice(ANGLES)))
        test = Test(f"{name}-0-{number:04d}", Scenario(road, seed=SEED + number))
        work[name].append(test)
    return work


def paired_difference(only_reduced: int, only_single: int, pairs: int) -> tuple[float, float, float]:
    """Estimate the difference of two failure rates, reduced minus single precision, in percentage points.

    Args:
        only_reduced: roads failed in reduced precision only.
        only_single: roads failed in single precision only.
        pairs: all roads.

    Returns:
        Difference and the ends of its 95% interval (D. G. Bonett, R. M. Price, "Adjusted Wald confidence interval for
        a difference of binomial proportions based on paired data", J. Educ. Behav. Stat. 37(4), 2012).
    """
    p, q = (only_reduced + 1) / (pairs + 2), (only_single + 1) / (pairs + 2)
    margin = stats.norm.ppf(0.975) * np.sqrt((p + q - (p - q) ** 2) / (pairs + 2))
    return 100 * (only_reduced - only_single) / pairs, 100 * (p - q - margin), 100 * (p - q + margin)


def compare(network: str, backend: str, single: DriveResults, reduced: DriveResults, console: Console) -> bool:
    """Print single precision and a backend side by side; return whether the rule holds for this network."""
    keys = sorted(single.executions.keys() & reduced.executions.keys(), key=lambda key: key[0].rpartition("-")[2])
    if not keys:
        console.print(f"{network}: no pair of drives yet")
        return False
    decided = [(single.executions[key], reduced.executions[key]) for key in keys]
    count = len(decided)
    table = Table(f"{network}: failures", *STANDARD, "all", "roads")
    for column, name in enumerate((SINGLE, backend)):
        failed = [pair[column].simulator for pair in decided if pair[column].outcome is not Outcome.COMPLETED]
        table.add_row(name, *(str(failed.count(s)) for s in STANDARD), str(len(failed)), str(count))
    console.print(table)
    failures = np.array([[drive.outcome is not Outcome.COMPLETED for drive in pair] for pair in decided])
    one, other = failures.T
    only_single, only_reduced = int((one & ~other).sum()), int((other & ~one).sum())
    estimate, lower, upper = paired_difference(only_reduced, only_single, count)
    gaps = np.abs([b.max_lateral_position - a.max_lateral_position for a, b in decided])
    holds = lower <= 0 <= upper and (upper - lower) / 2 <= HALF_WIDTH and count == ROADS
    for line in (
        f"verdicts that differ: {only_single} failed in single precision only, {only_reduced} with {backend} only",
        f"failure rate, {backend} minus single: {estimate:+.1f} percentage points ({lower:+.1f} to {upper:+.1f})",
        f"largest lateral position differs by {np.median(gaps):.4f} m in the median, {gaps.max():.3f} m at most",
        f"pairs with an error instead of a verdict, or not driven: {len(single.errors.keys() | reduced.errors.keys())}",
        f"rule for {ROADS} roads: {'holds' if holds else 'does not hold' if count >= ROADS else 'not yet decided'}",
    ):
        console.print(f"  {line}", highlight=False)
    return bool(holds)


def main() -> None:
    """Drive what is missing and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("precision"), help="folder of the finished drives")
    parser.add_argument("--roads", type=int, default=ROADS)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="processes")
    arguments = parser.parse_args()
    console, work, holds = Console(width=120), work_of(arguments.roads), []
    for network in NETWORKS:
        found = []
        for backend in (SINGLE, REDUCED):
            driver, folder = DriverName.parse(network).on(backend), arguments.out / f"{network}-{backend}"
            settings = DriveSettings(siblings=tuple(STANDARD), driver=driver, gates="none", workers=arguments.workers)
            found.append(drive_tests(settings, work, folder))
        holds.append(compare(network, REDUCED, found[0], found[1], console))
    console.print(f"{REDUCED} may be chosen for paper.yaml: {'yes' if all(holds) else 'no'}")


if __name__ == "__main__":
    main()
