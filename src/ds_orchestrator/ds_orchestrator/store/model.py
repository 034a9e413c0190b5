# SPDX-License-Identifier: Apache-2.0
"""Tests and their outcomes, and how a campaign's store reads them from rows that may hold anything."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ds_orchestrator.search.features import Drive
from ds_orchestrator.store import rows as check
from ds_orchestrator.store.sqlite_file import Row, SqliteFile
from ds_road import Road, Side
from ds_road.road import MAX_POINTS
from ds_sim.conditions.text import parse_conditions
from ds_sim.scenario import OfScenario, Scenario
from ds_sim.simulator import FRAME_TIME, Outcome


@dataclass(frozen=True, slots=True)
class Origin:
    """Place of a test in the search that generated it.

    Attributes:
        sibling: simulator that the search drove on.
        run: index of the search run, from 0.
        number: index of the test within the run, from 0.
    """

    sibling: str
    run: int
    number: int


NO_ORIGIN = Origin("", 0, 0)
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
    def sibling(self) -> str:
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
    """Every frame of a run.

    Attributes:
        trajectory: (steps + 1, 5) float64: x, y, yaw, speed, lateral position; m, rad, m/s.
        steering: (steps,) float64, the commands in [-1, 1].
    """

    trajectory: NDArray[np.float64]
    steering: NDArray[np.float64]


NO_DRIVE = DriveArrays(np.empty((0, 5)), np.empty(0))
_NOT_KEPT = check.pack_numbers(NO_DRIVE.trajectory)
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
    simulator: str
    outcome: Outcome
    message: str
    fitness: float
    max_lateral_position: float
    steps: int
    simulated_seconds: float
    trajectory_sha256: str
    drive: Drive
    bag: str = ""

    @property
    def trajectory(self) -> NDArray[np.float64]:
        """(steps + 1, 5): x, y, yaw, speed, lateral position; see `DriveArrays`."""
        return self.drive.trajectory

    @property
    def steering(self) -> NDArray[np.float64]:
        """(steps,) steering commands in [-1, 1]."""
        return self.drive.steering


VERDICTS = tuple(outcome.name for outcome in Outcome if outcome.is_verdict)
TEST_COLUMNS = (
    "test_id, sibling, run, number, control_points, seed, maxitwo_compatible, road_id, conditions, turns_count, "
    "curvature"
)  # fmt: skip
EXECUTION_COLUMNS = (
    "test_id, simulator, outcome, message, fitness, max_lateral_position, steps, simulated_seconds, trajectory_sha256, "
    "bag, rowid"
)
_conditions_of = lru_cache(maxsize=1024)(parse_conditions)  # most tests of a campaign have the same
_LARGEST_CURVATURE = 1e6
"""1/m; chosen: the inverse of a micrometre, so that no axis has more bins than memory."""
_TOLERANCE = 1e-6
"""m and s, between a stored value and the value derived from other columns."""


def test_of(row: Row, lane: Side) -> Test:
    """Make a test.

    Args:
        row: values of `TEST_COLUMNS`.
        lane: lane in which all roads of the campaign are driven.

    Raises:
        RowError: no campaign can have written the row; the message names test and column.
    """
    test_id, sibling, run, number, points, seed, maxitwo_compatible, road_id, conditions, turns, curvature = row
    try:
        origin = Origin(check.text(sibling, "sibling"), check.whole(run, "run"), check.whole(number, "number"))
        if not check.file_name(test_id, "test_id").endswith(f"-{run}-{number:04d}") and origin != NO_ORIGIN:
            raise check.RowError(f"test_id does not end in -{run}-{number:04d}")
        quirk = bool(check.whole(maxitwo_compatible, "maxitwo_compatible", high=1))
        road = Road(check.control_points(points), maxitwo_compatible=quirk, lane=lane)
        if road.road_id != road_id:
            raise check.RowError("road_id does not match the control points")
        # Computed when the test was stored; again they would take most of the time of reading a campaign.
        vars(road).update(
            turns_count=check.whole(turns, "turns_count", high=MAX_POINTS),
            curvature=check.real(curvature, "curvature", low=0.0, high=_LARGEST_CURVATURE),
        )
        under = _conditions_of(check.text(conditions, "conditions"))
        scenario = Scenario(road, under, seed=check.whole(seed, "seed"))
        return Test(test_id, scenario, None if origin == NO_ORIGIN else origin)
    except ValueError as error:
        raise check.RowError(f"the test {test_id!r:.60}: {error}") from None


def execution_of(row: Row, file: SqliteFile) -> Execution:
    """Make an execution of the values of `EXECUTION_COLUMNS`; its trajectory stays in the file until it is asked for.

    Raises:
        RowError: no campaign can have written the row; the message names test, simulator and column.
    """
    try:
        steps = check.whole(row[6], "steps", high=check.MOST_STEPS)
        test_id, simulator = check.text(row[0], "test_id"), sys.intern(check.text(row[1], "simulator"))
        execution = Execution(
            test_id=test_id,
            simulator=simulator,
            outcome=Outcome[check.one_of(row[2], "outcome", VERDICTS)],
            message=check.text(row[3], "message"),
            fitness=check.real(row[4], "fitness"),
            max_lateral_position=check.real(row[5], "max_lateral_position"),
            steps=steps,
            simulated_seconds=check.real(row[7], "simulated_seconds"),
            trajectory_sha256=check.sha256(row[8], "trajectory_sha256"),
            drive=StoredDrive(file, test_id, simulator, row[5], steps, row[8], row[10]),
            bag=check.bag_folder(row[9]),
        )
        if abs(execution.simulated_seconds - steps * FRAME_TIME) > _TOLERANCE:
            raise check.RowError(f"simulated_seconds is {execution.simulated_seconds:g} for {steps} steps")
        return execution
    except check.RowError as error:
        raise _unreadable(row[0], row[1], error) from None


@dataclass(frozen=True, eq=False, slots=True)
class StoredDrive:
    """Frames of a stored execution, read, decompressed and checked when they are asked for; the last ones are kept.

    A file whose store is closed by then is opened once more.

    Attributes:
        file: file of the campaign.
        rowid: of the execution; the other attributes are its own, as a large campaign has no memory for whole rows.

    Raises:
        StoreError: by its properties: no campaign can have written these frames.
    """

    file: SqliteFile
    test_id: str
    simulator: str
    max_lateral_position: float
    steps: int
    sha256: str
    rowid: int

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
        found = self.file.read("SELECT trajectory, steering FROM executions WHERE rowid=?", (self.rowid,))
        try:
            if not found:
                raise check.RowError("it was replaced meanwhile")
            if found[0][0] == _NOT_KEPT:
                return NO_DRIVE
            trajectory = check.unpack_trajectory(found[0][0], self.sha256, steps=self.steps)
            steering = check.unpack_numbers(found[0][1], "steering", count=self.steps)
            lateral = np.abs(trajectory[:, 4])
            if lateral.size and abs(lateral.max() - self.max_lateral_position) > _TOLERANCE:
                raise check.RowError("max_lateral_position does not match the trajectory")
            if np.abs(steering).max(initial=0.0) > 1.0:
                raise check.RowError("steering leaves [-1, 1]")
        except check.RowError as error:
            raise self.file.damaged(str(_unreadable(self.test_id, self.simulator, error))) from None
        return DriveArrays(trajectory, steering)


@lru_cache(maxsize=512)  # 10 MB of drives of the usual length
def _arrays_of(drive: StoredDrive) -> DriveArrays:
    return drive.read()


def _unreadable(test_id: object, simulator: object, error: check.RowError) -> check.RowError:
    return check.RowError(f"the run of {test_id!s:.60} on {simulator!s:.60} cannot be read: {error}")
