# SPDX-License-Identifier: Apache-2.0
"""Processor time and memory of the verbs that read a campaign, over its size.

`python -m benchmarks.large_store [--sizes 1200,10000,100000] [--verbs status,maps] [--keep FOLDER]` writes campaigns
without driving: real roads, made-up outcomes and trajectories. Each verb runs in a process of its own.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from functools import cache
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from ds_sim import SimulatorName

if TYPE_CHECKING:
    from ds_orchestrator.store.model import Execution, Test

VERBS = {
    "status": ("campaign", "status", "", "--json"),
    "maps": ("maps", "", "--json"),
    "predict": ("predict", "", "--json"),
    "evaluate": ("evaluate", "", "--json"),
    "report": ("report", ""),
}
"""Verb -> its words; the folder stands for the empty one."""
BUDGET, POPULATION = 200, 20
"""Tests of a search run, and the random roads among them; the others are mutants."""
_ROADS = 500
"""Random roads; those of further runs are shifted by a millimetre."""


def write_campaign(folder: Path, executions: int) -> None:
    """Write the store of a campaign with two siblings and a twin, finished but for its report."""
    from ds_orchestrator.campaign.config import parse_config
    from ds_orchestrator.store.store import Store

    runs = max(1, round(executions / (3 * 2 * BUDGET)))
    search = {"runs": runs, "population": POPULATION, "iterations": BUDGET - POPULATION}
    config = parse_config({"driver": "autopilot", "record": "none", "search": search}, "benchmark")
    folder.mkdir(parents=True, exist_ok=True)
    with closing(Store(folder / "campaign.sqlite", config=config.identity())) as store:
        for sibling in config.siblings:
            for run in range(runs):
                store.add_search(sibling, run, config.search.method, run)
        for run, sibling in product(range(runs), config.siblings):
            for test, drives in _tests(sibling, run, config.simulators):
                store.add_test(test)
                for drive in drives:
                    store.add_execution(drive)


def _tests(sibling: str, run: int, simulators: list[SimulatorName]) -> Iterator[tuple[Test, list[Execution]]]:
    """Tests of a run, each with its executions."""
    import numpy as np

    from ds_orchestrator.store.model import DriveArrays, Execution, Origin, Test
    from ds_orchestrator.store.rows import trajectory_sha256
    from ds_road import Road, generate
    from ds_road.generation import GENES
    from ds_sim.scenario import Scenario
    from ds_sim.simulator import Outcome

    roots = cache(lambda number: generate(np.random.default_rng(number), max_angle=200).control_points)
    rng = np.random.default_rng([run, *sibling.encode()])
    for number in range(BUDGET):
        root = POPULATION * run + int(rng.integers(POPULATION))
        points = np.array(roots(root % _ROADS)) + (0.001 * run, 0.001 * len(sibling))
        points[GENES[number % 3]] += rng.uniform(-1.0, 1.0, 2)
        road = Road(points)
        test = Test(
            f"{sibling}-{run}-{number:04d}", Scenario(road, seed=number), Origin(SimulatorName(sibling), run, number)
        )
        hardness = 4.0 * road.curvature + rng.normal(0.0, 0.2)
        drives = []
        along = np.linspace(0.0, len(road.points) - 1.0, 436)
        lane = [np.interp(along, np.arange(len(road.points)), line) for line in road.lane_centre.T]
        for k, simulator in enumerate(simulators):
            worst = float(np.exp(hardness - 0.6 + 0.2 * k + rng.normal(0.0, 0.3)))
            lateral = worst * np.sin(along * rng.uniform(0.05, 0.2))
            failed = bool(np.abs(lateral).max() > 2.0)
            frames = int(np.argmax(np.abs(lateral) > 2.0)) + 1 if failed else len(along)
            trajectory = np.column_stack((*lane, np.gradient(lane[1]), np.full(len(along), 8.0), lateral))[:frames]
            trajectory = np.round(trajectory * 2.0**12) / 2.0**12  # deflates, as a million have to fit on a disk
            steering = np.round(np.clip(trajectory[1:, 4] / 4.0, -1.0, 1.0) * 2.0**8) / 2.0**8
            largest = float(np.abs(trajectory[:, 4]).max())
            drives.append(
                Execution(
                    test_id=test.test_id,
                    simulator=SimulatorName(simulator),
                    outcome=Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED,
                    message="",
                    fitness=2.0 - largest,
                    max_lateral_position=largest,
                    steps=frames - 1,
                    simulated_seconds=(frames - 1) / 20,
                    trajectory_sha256=trajectory_sha256(trajectory),
                    drive=DriveArrays(trajectory, steering),
                )
            )
        yield test, drives


def measure(verb: str, folder: Path) -> tuple[float, float]:
    """Run a verb; return its processor time, s, and the most memory that it held, MB."""
    command = [sys.executable, "-m", "ds_cli.main", *(word or str(folder) for word in VERBS[verb])]
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(command, stdout=output, stderr=output)
        _, status, used = os.wait4(process.pid, 0)
        if status:
            output.seek(0)
            sys.exit(f"error: {' '.join(command)}: {output.read()[-500:].decode()}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sizes", default="1200,10000,100000", help="numbers of executions")
    parser.add_argument("--verbs", default=",".join(VERBS))
    parser.add_argument("--keep", type=Path, help="folder for the campaigns, which are used again")
    arguments = parser.parse_args()
    table = Table("verb", *(f"{int(size):,}" for size in arguments.sizes.split(",")))
    with tempfile.TemporaryDirectory() as temporary:
        folders = {int(size): (arguments.keep or Path(temporary)) / size for size in arguments.sizes.split(",")}
        for size, folder in folders.items():
            if not folder.exists():  # in a process of its own: a child's peak counts what its parent holds
                with ProcessPoolExecutor(1, get_context("spawn")) as own:
                    own.submit(write_campaign, folder, size).result()
        for verb in arguments.verbs.split(","):
            measured = (measure(verb, folder) for folder in folders.values())
            table.add_row(verb, *(f"{seconds:.1f} s {memory:.0f} MB" for seconds, memory in measured))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
