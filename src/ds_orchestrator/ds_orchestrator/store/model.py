# SPDX-License-Identifier: Apache-2.0
"""Tests and their outcomes, and how a campaign's store reads them from rows that may hold anything."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_file import FileError, load_json
from ds_orchestrator.search.features import DriveSeries
from ds_orchestrator.store import rows
from ds_orchestrator.store.sqlite_file import SqliteFile
from ds_road import road_from_json, road_to_json
from ds_sim.conditions.text import format_conditions, parse_conditions
from ds_sim.registry import NO_SIMULATOR, SimulatorName
from ds_sim.scenario import OfScenario, Scenario
from ds_sim.simulator import FRAME_TIME, Outcome


@dataclass(frozen=True, slots=True)
class Origin:
    """Place of a test in the search that generated it: run of a search on a sibling, and number in it, from 0."""

    sibling: SimulatorName
    run: int
    number: int


NO_ORIGIN = Origin(NO_SIMULATOR, 0, 0)
"""How the store writes that no search generated a test."""


@dataclass(frozen=True)
class Test(OfScenario):
    """Scenario with a name, which every simulator drives alike.

    Attributes:
        test_id: unique within a campaign; `<sibling>-<run>-<number>` if a search generated the test.
        scenario: road, operating conditions and seed of every execution.
        origin: which search generated it; None if none did.
    """

    __test__ = False  # not a test case for pytest

    test_id: str
    scenario: Scenario
    origin: Origin | None = None

    @property
    def sibling(self) -> SimulatorName:
        """Simulator whose search generated the test; "" without an origin."""
        return (self.origin or NO_ORIGIN).sibling

    @property
    def run(self) -> int:
        """Index of the search run; 0 without an origin."""
        return (self.origin or NO_ORIGIN).run

    @property
    def number(self) -> int:
        """Index of the test within its run; 0 without an origin."""
        return (self.origin or NO_ORIGIN).number


@dataclass(frozen=True, eq=False)
class DriveArrays:
    """Every frame of a run."""

    trajectory: NDArray[np.float64]  # (steps + 1, 5) float64: x, y, yaw, speed, lateral position; m, rad, m/s
    steering: NDArray[np.float64]  # (steps,) float64, the commands in [-1, 1]


NO_DRIVE = DriveArrays(np.empty((0, 5)), np.empty(0))
_NOT_KEPT = rows.pack_numbers(NO_DRIVE.trajectory)
"""Frames of an execution that was restored from a table of outcomes."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Execution:
    """Outcome of one test on one simulator.

    Attributes:
        test_id: id of the test.
        simulator: name of the simulator.
        outcome: how the run ended.
        message: reason in one line, or "" where the outcome alone explains it.
        fitness: smallest lateral distance of the run, m.
        max_lateral_position: largest absolute lateral position of the run, m.
        steps: frames driven.
        simulated_seconds: simulated time driven, s.
        trajectory_sha256: digest of the trajectory; see `ds_orchestrator.store.rows.trajectory_sha256`.
        drive: every frame; that of a stored execution is read when it is first asked for.
        bag: folder of the bag relative to the campaign folder, or "".
    """

    test_id: str
    simulator: SimulatorName
    outcome: Outcome
    message: str
    fitness: float
    max_lateral_position: float
    steps: int
    simulated_seconds: float
    trajectory_sha256: str
    drive: DriveSeries
    bag: str = ""

    @property
    def trajectory(self) -> NDArray[np.float64]:
        """(steps + 1, 5): x, y, yaw, speed, lateral position; see `DriveArrays`."""
        return self.drive.trajectory

    @property
    def steering(self) -> NDArray[np.float64]:
        """(steps,) steering commands in [-1, 1]."""
        return self.drive.steering


_conditions_of = lru_cache(maxsize=1024)(parse_conditions)  # most tests of a campaign have the same
_TOLERANCE = 1e-6
"""m and s, between a stored value and the value derived from other columns."""


def row_of(test: Test) -> rows.TestRow:
    """Convert a test to the form in which the store keeps it."""
    origin, road = test.origin or NO_ORIGIN, test.road
    return rows.TestRow(
        test_id=test.test_id,
        sibling=origin.sibling,
        run=origin.run,
        number=origin.number,
        road=json.dumps(road_to_json(road)),
        road_id=road.road_id,
        turns_count=road.turns_count,
        curvature=road.curvature,
        seed=test.seed,
        conditions=format_conditions(test.conditions),
    )


def test_of(row: rows.TestRow) -> Test:
    """Make a test; a `RowError` says why no campaign can have written the row."""
    origin = Origin(row.sibling, row.run, row.number)
    try:
        if not row.test_id.endswith(f"-{row.run}-{row.number:04d}") and origin != NO_ORIGIN:
            raise rows.RowError(f"test_id does not end in -{row.run}-{row.number:04d}")
        try:
            road = road_from_json(load_json(row.road))
        except FileError:
            raise rows.RowError("road is not JSON") from None
        if road.road_id != row.road_id:
            raise rows.RowError("road_id does not match the road")
        road.remember(turns_count=row.turns_count, curvature=row.curvature)
        scenario = Scenario(road, _conditions_of(row.conditions), seed=row.seed)
    except ValueError as error:
        raise rows.RowError(f"the test {row.test_id}: {error}") from None
    return Test(row.test_id, scenario, None if origin == NO_ORIGIN else origin)


def execution_of(row: rows.ExecutionRow, file: SqliteFile) -> Execution:
    """Make an execution, whose trajectory stays in the file until it is asked for; errors as in `test_of`."""
    if abs(row.simulated_seconds - row.steps * FRAME_TIME) > _TOLERANCE:
        raise _unreadable(row.test_id, row.simulator, f"simulated_seconds is {row.simulated_seconds:g}")
    values = row._asdict() | {"outcome": Outcome[row.outcome]}
    rowid, digest = values.pop("rowid"), row.trajectory_sha256
    drive = StoredDrive(file, row.test_id, row.simulator, row.max_lateral_position, row.steps, digest, rowid)
    return Execution(**values, drive=drive)


@dataclass(frozen=True, eq=False, slots=True)
class StoredDrive:
    """Frames of a stored execution, read, decompressed and checked when they are asked for; the last ones are kept.

    A file whose store is closed by then is opened once more. StoreError if no campaign can have written these frames.
    """

    file: SqliteFile
    test_id: str
    simulator: SimulatorName
    max_lateral_position: float
    steps: int
    sha256: str
    rowid: int  # of the execution; the other attributes are its own, as a large campaign has no memory for whole rows

    @property
    def trajectory(self) -> NDArray[np.float64]:
        """(steps + 1, 5); see `DriveArrays`."""
        return _arrays_of(self).trajectory

    @property
    def steering(self) -> NDArray[np.float64]:
        """(steps,); see `DriveArrays`."""
        return _arrays_of(self).steering

    def read(self) -> DriveArrays:
        """Read every frame; there are none where a campaign was restored from a table of outcomes."""
        packed = self.file.read("SELECT trajectory, steering FROM executions WHERE rowid=?", (self.rowid,))
        try:
            if not packed:
                raise rows.RowError("it was replaced meanwhile")
            if packed[0][0] == _NOT_KEPT:
                return NO_DRIVE
            trajectory = rows.unpack_trajectory(packed[0][0], self.sha256, steps=self.steps)
            steering = rows.unpack_numbers(packed[0][1], "steering", count=self.steps)
            lateral = np.abs(trajectory[:, 4])
            if lateral.size and abs(lateral.max() - self.max_lateral_position) > _TOLERANCE:
                raise rows.RowError("max_lateral_position does not match the trajectory")
            if np.abs(steering).max(initial=0.0) > 1.0:
                raise rows.RowError("steering leaves [-1, 1]")
        except rows.RowError as error:
            raise self.file.damaged(str(_unreadable(self.test_id, self.simulator, error))) from None
        return DriveArrays(trajectory, steering)


_arrays_of = lru_cache(maxsize=512)(StoredDrive.read)  # 10 MB of drives of the usual length


def _unreadable(test_id: str, simulator: SimulatorName, error: object) -> rows.RowError:
    return rows.RowError(f"the run of {test_id:.60} on {simulator:.60} cannot be read: {error}")
