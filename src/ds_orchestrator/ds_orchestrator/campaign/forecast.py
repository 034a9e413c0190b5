# SPDX-License-Identifier: Apache-2.0
"""Forecasts a campaign from measured drives: how many there are, how long they take, how much they write."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ds_driver.closed_loop.simulation import DriveRequest
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.engine import Engine
from ds_orchestrator.campaign.executor import execution_of
from ds_orchestrator.store.rows import pack_numbers
from ds_road import generate
from ds_sim.registry import SimulatorName, label_of
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord


@dataclass(frozen=True, kw_only=True)
class MeasuredDrive:
    """A drive of the forecast: wall-clock time beside the others, and bytes that it would leave in the folder."""

    simulator: SimulatorName
    outcome: str
    seconds: float
    disk: int


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """What a campaign takes."""

    drives: int  # at most
    search_drives: int  # of them, by searches, each of which drives one test after the other
    searches: int
    gate_drives: int  # of the autopilot at most, which decide whether a test is valid
    start_seconds: float  # measured time in which the engine started
    measured: tuple[MeasuredDrive, ...]  # the drives that were measured, all at the same time
    free: int  # free bytes of the disk

    @property
    def seconds(self) -> float:
        """Estimate of the wall-clock time, if all drives are as long as the measured ones.

        As many run at a time as were measured; the searches, one drive for each of them, may take longer than that.
        """
        at_once = len(self.measured)
        mean = sum(drive.seconds for drive in self.measured) / at_once
        with_gates = mean * (self.drives + self.gate_drives) / self.drives
        longest = max(self.drives / at_once, self.search_drives / min(at_once, self.searches))
        return self.start_seconds + longest * with_gates

    @property
    def disk(self) -> int:
        """Estimate of the bytes in the campaign folder, report not included."""
        return round(self.drives * sum(drive.disk for drive in self.measured) / len(self.measured))


def measure(config: CampaignConfig, engine: Engine, folder: Path, *, start_seconds: float) -> Forecast:
    """Drive one random road on every simulator at the same time, and estimate the campaign from it.

    With several workers, so many roads on each as the machine has processors for; RuntimeError if a drive ends in an
    error. Nothing is written to the folder, which need not exist. The engine took `start_seconds` to start.
    """
    each = min(config.workers, max(1, len(os.sched_getaffinity(0)) // len(config.simulators)))
    work = [(name, k) for k in range(each) for name in config.simulators]

    def drive(unit: tuple[SimulatorName, int]) -> tuple[SimulatorName, RunRecord, float]:
        name, k = unit
        road = generate(np.random.default_rng([config.seed, k]), max_angle=config.search.max_angle, lane=config.lane)
        since = time.monotonic()
        scenario = Scenario(road, config.conditions, seed=config.seed % 2**32)
        run = engine.drive(DriveRequest(scenario, config.driver, name))
        return name, run, time.monotonic() - since

    with ThreadPoolExecutor(len(work)) as pool:
        runs = list(pool.map(drive, work))
    for name, run, _ in runs:
        if not run.outcome.is_verdict:
            raise RuntimeError(f"{name}: {run.outcome.name.lower()}: {run.message}: fix it before the campaign starts")
    place = folder.absolute()
    return Forecast(
        drives=config.executions_at_most,
        search_drives=config.tests,
        searches=config.search.runs * len(config.siblings),
        gate_drives=config.executions_at_most if config.has_gates else 0,
        start_seconds=start_seconds,
        measured=tuple(
            MeasuredDrive(simulator=name, outcome=run.outcome.name, seconds=took, disk=_disk(config, name, run))
            for name, run, took in runs
        ),
        free=shutil.disk_usage(next(path for path in (place, *place.parents) if path.exists())).free,
    )


def _disk(config: CampaignConfig, simulator: SimulatorName, run: RunRecord) -> int:
    """Bytes of a run in the store and of its bag, which is written to a temporary folder."""
    execution = execution_of("forecast", simulator, run)
    stored = len(pack_numbers(execution.trajectory)) + len(pack_numbers(execution.steering))
    if config.record == "none":
        return stored
    from ds_bags.run_writer import write_bag

    with tempfile.TemporaryDirectory(prefix="ds_forecast_") as folder:
        bag = Path(folder) / label_of(simulator)
        write_bag(bag, "/ds1", simulator, run, {"driver": str(config.driver)}, config.record)
        return stored + sum(file.stat().st_size for file in bag.rglob("*") if file.is_file())
