"""Memory of scheduler, workers and campaign over many drives with the engine `dask`.

`python -m benchmarks.scheduler_memory [--drives 10000] [--workers 2]` drives a simulator of a few milliseconds, so that
it is the engine that is measured, and prints the resident memory of each process after every tenth of the drives.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table
from tests.engines.dask_processes import DaskProcesses

from ds_driver.closed_loop.drive_request import DriveRequest
from ds_orchestrator.campaign.drive_settings import DriveSettings
from ds_orchestrator.engines.cluster import ClusterOptions
from ds_orchestrator.engines.dask_engine import MOST_THREADS, running_dask
from ds_road import generate

QUICK = "tests.engines.quick_simulator:QuickSimulator"


def megabytes(pid: int) -> float:
    """Resident memory of a process."""
    return float(psutil.Process(pid).memory_info().rss) / 2**20


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--drives", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    road = generate(np.random.default_rng(0), max_angle=150)
    table = Table("drives", "scheduler MB", "campaign MB", "worker MB", "drives / s")
    with tempfile.TemporaryDirectory() as name:
        cluster = DaskProcesses(Path(name))
        workers = [cluster.worker() for _ in range(arguments.workers)]
        settings = DriveSettings(
            siblings=(QUICK,), driver="autopilot", cluster=ClusterOptions(scheduler=cluster.address)
        )
        try:
            with (
                running_dask(settings, folder=Path(name), say=print) as engine,
                ThreadPoolExecutor(MOST_THREADS) as pool,
            ):
                part = arguments.drives // 10
                for tenth in range(10):
                    started = time.perf_counter()
                    seeds = range(tenth * part, (tenth + 1) * part)
                    runs = list(
                        pool.map(lambda seed: engine.drive(DriveRequest(QUICK, "autopilot", road, seed)), seeds)
                    )
                    assert all(run.outcome.is_verdict for run in runs)
                    rate = part / (time.perf_counter() - started)
                    sizes = (megabytes(pid) for pid in (cluster.scheduler.pid, psutil.Process().pid, workers[0].pid))
                    table.add_row(str((tenth + 1) * part), *(f"{size:.0f}" for size in sizes), f"{rate:.0f}")
                    print(f"{(tenth + 1) * part} drives", flush=True)
        finally:
            cluster.close()
    Console().print(table)


if __name__ == "__main__":
    main()
