# SPDX-License-Identifier: Apache-2.0
"""State of a campaign, read while another process writes it, as JSON values from which the page draws."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ds_base.folder_files import StoreError
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData, config_of, open_store
from ds_orchestrator.campaign.live_file import Live, LiveDrive, read_live
from ds_orchestrator.campaign.status import stages_of
from ds_orchestrator.maps.campaign_maps import cell_of_test
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import NO_DRIVE, Execution, Test
from ds_orchestrator.store.store import Store
from ds_report.camera_pictures import SPACINGS, PicturedDrive, render_drive, replay_frames, trusted_simulator
from ds_report.page_data import axes_of, kept, simulator_rows
from ds_road.geometry import arc_lengths
from ds_sim.registry import SimulatorName
from ds_sim.simulator import Outcome, Simulator


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A campaign at one moment."""

    data: CampaignData  # contents of the store; executions without their trajectories
    latest: dict[str, str]  # simulator -> test that was driven there last
    live: Live | None  # what the campaign does, or None if no process works on it
    complete: bool  # whether everything was driven and the report is up to date
    at: float  # time of reading, s since 1970


@dataclass
class _Known:
    """What was read so far."""

    config: CampaignConfig
    tests: dict[str, Test] = field(default_factory=dict)
    executions: dict[tuple[str, SimulatorName], Execution] = field(default_factory=dict)
    cells: dict[str, Cell] = field(default_factory=dict)
    rows: tuple[int, int] = (0, 0)
    last_test: str | None = None


class CampaignReader:
    """Reads the campaign in a folder, without writing to it and without taking a lock.

    Raises:
        ds_orchestrator.store.sqlite_file.StoreError: the folder holds no campaign, or a damaged one.
        ds_orchestrator.campaign.config.ConfigError: its configuration is not valid.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with self._opened() as store:
            self._known = _Known(config=config_of(store))

    @property
    def config(self) -> CampaignConfig:
        """The campaign's configuration."""
        return self._known.config

    def read(self) -> Snapshot:
        """Read what is new; `StoreError` if the file is damaged, or was replaced while it was read."""
        with self._opened() as store:
            try:
                self._read_new(store)
            except StoreError:
                self._known = _Known(config=self._known.config)
                raise
            campaign, results, count = self._known, store.results(), store.count_results()
            latest = store.latest_executions()
            data = CampaignData(
                config=campaign.config,
                tests=tuple(campaign.tests.values()),
                executions=tuple(campaign.executions.values()),
                gates=store.gates(),
                errors=tuple(store.errors()),
                given_up=frozenset(store.given_up()),
                results=results,
            )
        # The cells were computed with the trajectories, which are not kept.
        vars(data)["cells"] = dict(campaign.cells)
        now = time.time()
        live = read_live(self.folder, now)
        driven = len(campaign.executions) + len(data.excluded)
        complete = campaign.config.elites_only or driven >= campaign.config.executions_at_most
        complete = complete and results.get("report") == count
        return Snapshot(
            data=data,
            latest={name: test_id for name, test_id in latest.items() if (test_id, name) in campaign.executions},
            live=live,
            complete=complete,
            at=now,
        )

    def execution(self, test_id: str, simulator: SimulatorName) -> tuple[Test, Execution] | None:
        """Read one execution with its trajectory, and its test; None if there is none."""
        test = self._known.tests.get(test_id)
        if test is None:
            return None
        with self._opened() as store:
            execution = store.execution(test_id, simulator)
        return None if execution is None else (test, execution)

    def _opened(self) -> closing[Store]:
        return closing(open_store(self.folder))

    def _read_new(self, store: Store) -> None:
        campaign = self._known
        last = store.last_rows()
        same = store.test_of_row(campaign.rows[0]) == campaign.last_test and last[1] >= campaign.rows[1]
        if not same or store.count_tests() < len(campaign.tests):
            # A stopped search took back its last tests, or the folder was replaced.
            campaign = self._known = _Known(config=config_of(store))
        executions = store.executions(after=campaign.rows[1])
        # Tests after executions: a test is stored before its executions.
        campaign.tests |= {test.test_id: test for test in store.tests(after=campaign.rows[0])}
        gates = store.gates()
        for execution in executions:
            test = campaign.tests.get(execution.test_id)
            if test is None or execution.simulator not in campaign.config.simulators:
                raise StoreError(f"{self.folder} has changed while it was read")
            campaign.executions[execution.test_id, execution.simulator] = replace(execution, drive=NO_DRIVE)
            cell = cell_of_test(
                test,
                execution if execution.simulator == test.sibling else None,
                gates.get((execution.test_id, test.sibling)),
                campaign.config.features,
                maxitwo_compatible=campaign.config.maxitwo_compatible,
            )
            if cell is not None:
                campaign.cells[execution.test_id] = cell
        campaign.rows, campaign.last_test = last, store.test_of_row(last[0])


class DrivePictures:
    """Renders camera pictures of drives from their recorded paths, of trusted simulators; for one thread only."""

    def __init__(self, driver: DriverName, trusted: Collection[str] = ()) -> None:
        self._driver, self._trusted = driver, trusted
        self._simulators: dict[str, Simulator | str] = {}
        """The simulators, or why they cannot be made."""

    def render(self, test: Test, execution: Execution) -> dict[str, Any]:
        """Render a picture every half second, as `ds_report.camera_pictures.PicturedDrive` in JSON values."""
        name = execution.simulator
        if name not in self._simulators:
            self._simulators[name] = trusted_simulator(name, self._trusted)
        simulator = self._simulators[name] if len(execution.trajectory) else "no frame"
        if isinstance(simulator, str):
            return asdict(PicturedDrive(note=f"no pictures: {simulator}"))
        frames = replay_frames(execution, SPACINGS[0])
        return asdict(render_drive(simulator, test, execution, frames, self._driver))

    def close(self) -> None:
        """Close the simulators."""
        for simulator in self._simulators.values():
            if not isinstance(simulator, str):
                simulator.close()
        self._simulators.clear()


_OUTLINE = 250
"""Points of the drawn edge of a road; chosen: all of a usual road, and no more of the longest."""


def page_state(snapshot: Snapshot) -> dict[str, Any]:
    """Collect what the page shows.

    Keys: `state` in words, `driver`, `done` and `total` executions, `seconds_left` or None, `simulators` with failures
    and tests (each scenario once), `stages`, `axes` and `maps` (cells: two bins, tests, failures), `now` (drives under
    way, their road's edges as points and the car's place), `errors` and `excluded` as numbers.
    """
    data, live = snapshot.data, snapshot.live
    config, counted = data.config, data.distinct
    verdicts = data.verdicts
    stages = stages_of(data)
    drives = [stage for stage in stages if stage.failures is not None]
    total = sum(stage.expected for stage in drives if stage.expected is not None)
    if any(stage.expected is None for stage in drives):
        total = config.executions_at_most
    by_road: dict[tuple[str, int], list[Test]] = {}
    for test in data.tests:
        by_road.setdefault((test.road.road_id, test.seed), []).append(test)
    return {
        "state": "running" if live is not None else "done" if snapshot.complete else "stopped",
        "stage": live.stage if live else "",
        "driver": str(config.driver),
        "done": len(verdicts) + len(data.excluded),
        "total": total,
        "seconds_left": live.seconds_left if live else None,
        "errors": len(data.errors),
        "last_error": "".join(
            f"{test_id} on {name}: {Outcome[outcome].words}, {message}"
            for test_id, name, _, outcome, message in data.errors[-1:]
        ),
        "excluded": len(data.excluded),
        "tests": len(counted.tests),
        "lane": round(data.tests[0].road.lane_width, 3) if data.tests else 4.0,
        "simulators": [
            {**row, **counted.failures[row["name"]]._asdict(), "latest": snapshot.latest.get(row["name"])}
            for row in simulator_rows(config)
        ],
        "stages": [
            {name: getattr(stage, name) for name in ("name", "done", "expected", "failures", "state")}
            for stage in stages
        ],
        "axes": [
            {"title": axis["title"], "low": axis["low"], "labels": axis["begins"][:-1]}
            for axis in axes_of(config, data.cells.values())[:2]
        ],
        "maps": _maps(snapshot),
        "now": [_under_way(drive, by_road, snapshot.at) for drive in (live.drives if live else [])],
    }


def _maps(snapshot: Snapshot) -> dict[str, list[list[int]]]:
    """Simulator -> its cells over the first two features: bins, tests, failures."""
    tallies: dict[str, dict[tuple[int, int], list[int]]] = {name: {} for name in snapshot.data.config.simulators}
    for execution in snapshot.data.verdicts:
        cell = snapshot.data.cells.get(execution.test_id)
        if cell is not None:
            counts = tallies[execution.simulator].setdefault((cell[0], cell[1]), [0, 0])
            counts[0] += 1
            counts[1] += execution.outcome.is_failure
    return {name: [[*cell, *counts] for cell, counts in sorted(cells.items())] for name, cells in tallies.items()}


def _under_way(drive: LiveDrive, by_road: dict[tuple[str, int], list[Test]], now: float) -> dict[str, Any]:
    """Describe a drive under way; `test` is "" if its road is not in the store yet."""
    tests = by_road.get((drive.road_id, drive.seed), [])
    said: dict[str, Any] = {
        "simulator": drive.simulator,
        "test": tests[-1].test_id if tests else "",
        "seconds": round(max(0.0, now - drive.began), 1),
        "step": drive.step,
        "progress": drive.progress,
        "lateral": drive.lateral_position,
    }
    if not tests:
        return said
    road = tests[-1].road
    few = np.unique(np.linspace(0, len(road.points) - 1, _OUTLINE).round().astype(int))
    said["road"] = [np.round(line, 1).tolist() for line in (*road.left_edge[few].T, *road.right_edge[few].T)]
    if drive.progress is not None and drive.lateral_position is not None:
        at, along = drive.progress * road.length, arc_lengths(road.lane_centre)
        ahead = min(at + 1.0, along[-1])
        (x, *xs), (y, *ys) = (np.interp((at, ahead - 1.0, ahead), along, line).tolist() for line in road.lane_centre.T)
        yaw, right = math.atan2(ys[1] - ys[0], xs[1] - xs[0]), drive.lateral_position
        said["car"] = [round(x + right * math.sin(yaw), 2), round(y - right * math.cos(yaw), 2), round(yaw, 3)]
    return said


def drive_lines(test: Test, execution: Execution, names: Sequence[str]) -> dict[str, Any]:
    """Describe one finished drive as the report's script unpacks it: the road, and a run per simulator or None."""
    path, lines = execution.trajectory, {"c": test.road.points, "l": test.road.left_edge, "r": test.road.right_edge}
    road = {
        name + axis: np.round(line[:, k], 2).tolist() for name, line in lines.items() for k, axis in enumerate("xy")
    }
    steps = kept(len(path) - 1) if len(path) else np.empty(0, np.intp)
    x, y, lateral = (np.round(path[steps, k], 2).tolist() for k in (0, 1, 4))
    steering = execution.steering
    commands = steering[np.minimum(steps, len(steering) - 1)] if len(steering) else steering
    run = {
        "outcome": execution.outcome.words,
        "failed": execution.outcome.is_failure,
        "seconds": execution.simulated_seconds,
        "fitness": execution.fitness,
        "x": x,
        "y": y,
        "lateral": lateral,
        "steering": [round(float(v), 3) for v in commands],
        "time": [round(int(step) / 20, 2) for step in steps],
        "distance": [round(float(v), 1) for v in arc_lengths(path[steps, :2])[: len(steps)]],
    }
    return {
        "id": test.test_id,
        "road": road,
        "runs": [run if name == execution.simulator else None for name in names],
    }
