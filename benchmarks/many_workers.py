# SPDX-License-Identifier: Apache-2.0
"""The engine `dask` with as many workers as this machine could never carry, whose drives are waited for, not driven.

`python benchmarks/many_workers.py [--workers 100] [--drives 100000] [--seconds 2.2]` runs a campaign through a real
scheduler; a worker's drive is a pause, of log-normal length, and a made-up run of 20 s. It prints processor time and
memory of the campaign and of the scheduler as they grow, and which share of the workers' time was used.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil

SPREAD = 0.3
"""Standard deviation of the logarithm of a drive's length; chosen: about that of the paper's campaign."""
THREADS = 25
"""Workers in one process."""
REPORT_EVERY = 2_000
PAUSE = "DS_BENCHMARK_PAUSE"
"""Environment variable with the mean length of a drive, s."""


class Pause:
    """Stands in for `ds_driver.closed_loop.worker_process.WorkerProcess`."""

    def __init__(self, seconds: float) -> None:
        from ds_sim.session import NO_IMAGE
        from ds_sim.simulator import Command, LaneState, Observation, Outcome, VehicleState

        self._seconds = seconds
        self._frames = [
            Observation(
                image=NO_IMAGE, step=k, time=k / 20,
                vehicle=VehicleState(x=125.0, y=0.4 * k, yaw=math.pi / 2, speed=8.0, yaw_rate=0.0, steering_angle=0.0),
                lane=LaneState(lateral_position=0.0, lateral_distance=2.0, preview_lateral_position=0.0,
                               arc_length=0.4 * k),
                outcome=Outcome.RUNNING,
            )
            for k in range(401)
        ]  # fmt: skip
        self._commands = [Command(steering=0.0, throttle=0.3)] * 400

    def start(self) -> int:
        """Return the number of drives that a process takes at a time."""
        return 1

    def drive(self, request: Any) -> Any:
        """Wait, and make a run up: the worse the sharper the road bends."""
        import numpy as np

        from ds_sim.session import RunRecord
        from ds_sim.simulator import Outcome

        rng = np.random.default_rng(
            [zlib.crc32(request.simulator.encode()), zlib.crc32(str(request.road.road_id).encode())]
        )
        time.sleep(self._seconds * float(rng.lognormal(-(SPREAD**2) / 2, SPREAD)))
        worst = float(math.exp(4.0 * request.road.curvature - 0.5 + rng.normal(0.0, 0.3)))
        outcome = Outcome.OUT_OF_BOUNDS if worst > 2.0 else Outcome.COMPLETED
        last = self._frames[-1]
        lane = replace(last.lane, lateral_position=worst, lateral_distance=2.0 - worst)
        frames = [*self._frames[:-1], replace(last, lane=lane, outcome=outcome)]
        return RunRecord(scenario=request.scenario, observations=frames, commands=self._commands, outcome=outcome)

    def close(self) -> None:
        """End."""


def dask_setup(worker: Any) -> None:
    """Make a Dask worker pause instead of driving; called by `dask worker --preload`."""
    from ds_orchestrator.engines import dask_worker

    seconds = float(os.environ[PAUSE])
    dask_worker.WorkerProcess = lambda *_, **__: Pause(seconds)  # type: ignore[assignment, attr-defined, misc]


class Meter:
    """Counts drives; says now and then what campaign and scheduler have used."""

    def __init__(self, scheduler: psutil.Process, seconds: float, workers: int) -> None:
        self._processes = {"campaign": psutil.Process(), "scheduler": scheduler}
        self._lock, self._done = threading.Lock(), 0
        self._began, self._seconds, self._workers = time.monotonic(), seconds, workers

    def count(self) -> None:
        """Count a drive."""
        with self._lock:
            self._done += 1
            if self._done % REPORT_EVERY == 0:
                self.say()

    def say(self) -> None:
        """Print one line."""
        wall = time.monotonic() - self._began
        used = ", ".join(
            f"{name} {process.memory_info().rss / 2**20:.0f} MB, {sum(process.cpu_times()[:2]) / self._done:.4f} s"
            for name, process in self._processes.items()
        )
        share = self._done * self._seconds / (self._workers * wall)
        print(
            f"{self._done} drives, {self._done / wall:.1f} a second, {share:.0%} of the workers' time; {used}",
            flush=True,
        )


def run(drives: int, workers: int, seconds: float, folder: Path) -> None:
    """Drive the campaign."""
    from ds_orchestrator.campaign.config import parse_config
    from ds_orchestrator.campaign.executor import Listener
    from ds_orchestrator.campaign.runner import Campaign
    from ds_orchestrator.engines.cluster import ClusterOptions
    from ds_orchestrator.engines.start import running_engine
    from ds_orchestrator.store.store import Store

    budget = 100
    raw = {
        "driver": "autopilot", "engine": "dask", "record": "none",
        "search": {"population": 20, "iterations": budget - 20, "runs": max(1, round(drives / (6 * budget)))},
    }  # fmt: skip
    config = parse_config(raw, "benchmark")
    (folder / "bags").mkdir()
    with ExitStack() as stack:

        def start(*command: str) -> psutil.Popen:
            process = psutil.Popen([sys.executable, "-m", "distributed.cli." + command[0], *command[1:]],
                                   env=os.environ | {PAUSE: str(seconds)}, stdout=subprocess.DEVNULL,
                                   stderr=(Path(tempfile.gettempdir()) / "many_workers.log").open("a"))  # fmt: skip
            stack.callback(process.wait, 30)
            stack.callback(process.terminate)
            return process

        address = "tcp://127.0.0.1:8799"
        scheduler = start("dask_scheduler", "--host", "127.0.0.1", "--port", "8799", "--no-dashboard")
        for _ in range(math.ceil(workers / THREADS)):
            start(
                "dask_worker", address, "--host", "127.0.0.1", "--nthreads", str(min(workers, THREADS)),
                "--no-dashboard", "--no-nanny", "--memory-limit", "0", "--local-directory", str(folder / "dask"),
                "--preload", __file__,
            )  # fmt: skip
        time.sleep(10)
        settings = config.drive_settings(cluster=ClusterOptions(scheduler=address))
        store = stack.enter_context(closing(Store(folder / "campaign.sqlite", config=config.identity())))
        engine = stack.enter_context(running_engine(settings, logs=folder / "logs"))
        meter = Meter(scheduler, seconds, workers)

        class Counter(Listener):
            def finished(self, test: Any, simulator: str, execution: Any, fresh: bool) -> None:
                meter.count()

        Campaign(config, folder, store, engine, Counter()).run()
        meter.say()


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=2.2, help="mean length of a drive")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run(arguments.drives, arguments.workers, arguments.seconds, Path(folder))


if __name__ == "__main__":
    main()
