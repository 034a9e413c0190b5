# SPDX-License-Identifier: Apache-2.0
"""Speed of a campaign with each engine, from its first drive to its last.

`python -m benchmarks.campaign [--drives 200] [--case ENGINE:DRIVER ...] [--workers 2]` drives the same small campaign
once per case, each in a process of its own, and prints frames per second of processor time (of all processes together)
and of wall-clock time, and the share of the cores that was idle. Every case must give the same trajectories for the
same back end, or the benchmark fails.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

CASES = (
    "local:dave2_short@onnx",
    "local:dave2_short@openvino",
    "local:dave2_short@openvino-bf16",
    "graph:dave2_short@openvino",
    "graph:dave2_short@openvino-bf16",
)


def processor_time() -> float:
    """Processor time of this process and of every process below it, s."""
    total = 0.0
    for process in (own := psutil.Process(), *own.children(recursive=True)):
        times = process.cpu_times()
        total += times.user + times.system
    return float(total)


def drive(engine: str, driver: str, drives: int, workers: int) -> dict[str, Any]:
    """Drive one campaign; returns its measures. Runs in a process of its own."""
    from ds_orchestrator.campaign.config import parse_config
    from ds_orchestrator.campaign.executor import Listener
    from ds_orchestrator.campaign.runner import Campaign
    from ds_orchestrator.engines.start import running_engine
    from ds_orchestrator.store.store import Store

    tests = max(2, round(drives / 12))  # two runs on each of two siblings, each test on three simulators
    raw = {
        "driver": driver,
        "engine": engine,
        "workers": workers if engine != "graph" else 1,
        "search": {"population": tests // 2, "iterations": tests - tests // 2, "runs": 2},
    }
    config = parse_config(raw, "benchmark")
    with (
        tempfile.TemporaryDirectory() as temporary,
        closing(Store(Path(temporary) / "campaign.sqlite", config=config.identity())) as store,
    ):
        folder = Path(temporary)
        (folder / "bags").mkdir()
        started = time.perf_counter()
        with running_engine(config.drive_settings(), logs=folder / "logs") as started_engine:
            ready = time.perf_counter()
            Campaign(config, folder, store, started_engine, Listener()).run()
            ended, processor = time.perf_counter(), processor_time()
        executions = store.executions()
    return {
        "drives": len(executions),
        "frames": sum(e.steps for e in executions),
        "start": ready - started,
        "wall": ended - ready,
        "processor": processor,
        "digest": sorted((e.test_id, e.simulator, e.trajectory_sha256) for e in executions),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--case", action="append", help="ENGINE:DRIVER; repeatable")
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    paces = ("frames / CPU s", "frames / s", "CPU s / drive")
    table = Table("engine", "driver", "drives", "frames", *paces, "idle", "start s")
    digests: dict[str, object] = {}
    for case in arguments.case or CASES:
        engine, _, driver = case.partition(":")
        with ProcessPoolExecutor(1, get_context("spawn")) as own:
            measures = own.submit(drive, engine, driver, arguments.drives, arguments.workers).result()
        if digests.setdefault(driver, measures["digest"]) != measures["digest"]:
            sys.exit(f"error: {case} gives other trajectories than another engine with the same driver")
        drives, frames, wall, processor = (measures[name] for name in ("drives", "frames", "wall", "processor"))
        idle = max(1.0 - processor / (cores * (wall + measures["start"])), 0.0)
        times = f"{frames / processor:.0f}", f"{frames / wall:.0f}", f"{processor / drives:.2f}", f"{idle:.0%}"
        table.add_row(engine, driver, str(drives), str(frames), *times, f"{measures['start']:.1f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
