# SPDX-License-Identifier: Apache-2.0
"""Cost of recording: bytes and time per frame at each level, and size of a campaign's bags.

`python benchmarks/bags.py [--sim donkey] [--roads 5]`. A bag is written after its run, from the record that the graph
returns, so that recording does not slow down the loop; a campaign waits for it before its next test. For levels with
images the run is re-simulated to get them.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ds_bags.layout import LEVELS, Level
from ds_bags.run_writer import write_bag
from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_road import generate
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.session import RunRecord

TESTS = 5000
"""Number of tests of a campaign; each is driven on two siblings and the twin."""


def bytes_in(folder: Path) -> int:
    """Total size of all files in a folder, bytes."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def costs(sim: str, runs: list[RunRecord], folder: Path) -> dict[Level, tuple[float, float, float]]:
    """Level -> bytes per frame, us per frame, and kB per bag; medians over the runs after a warm-up."""
    found = {}
    for level in LEVELS:
        sizes, times, whole = [], [], []
        for run in [runs[0], *runs]:
            started = time.perf_counter()
            write_bag(folder / level, "/ds1", SimulatorName(sim), run, {}, level)
            took = time.perf_counter() - started
            frames = len(run.observations)
            sizes.append(bytes_in(folder / level) / frames)
            times.append(1e6 * took / frames)
            whole.append(bytes_in(folder / level) / 1e3)
        found[level] = (statistics.median(sizes[1:]), statistics.median(times[1:]), statistics.median(whole[1:]))
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sim", default="donkey")
    parser.add_argument("--roads", type=int, default=5)
    options = parser.parse_args()
    rng = np.random.default_rng(7)
    roads = [generate(rng, max_angle=270) for _ in range(options.roads)]
    simulator = make_simulator(options.sim)
    runs = [drive_road(simulator, make_driver("autopilot", simulator.spec), road, 0) for road in roads]
    frames = statistics.mean(len(run.observations) for run in runs)
    console = Console()
    with tempfile.TemporaryDirectory() as scratch:
        table = Table("level", "kB per frame", "us per frame", f"bag of {frames:.0f} frames, kB")
        found = costs(options.sim, runs, Path(scratch))
        for level, (size, took, whole) in found.items():
            table.add_row(level, f"{size / 1e3:.2f}", f"{took:.0f}", f"{whole:.0f}")
        console.print(table)
        bags = TESTS * 3
        for level, (_, _, whole) in found.items():
            console.print(
                f"{TESTS} tests x 3 simulators, {level}: {bags} bags, {2 * bags} files, {bags * whole / 1e6:.1f} GB"
            )


if __name__ == "__main__":
    main()
