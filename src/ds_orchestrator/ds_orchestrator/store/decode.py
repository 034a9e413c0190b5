"""Makes values of rows of a campaign's store; every column is checked, since a received file may hold anything."""

from __future__ import annotations

import numpy as np

from ds_orchestrator.store import rows as check
from ds_orchestrator.store.model import Execution, Test
from ds_orchestrator.store.sqlite_file import Row
from ds_road import Road, Side
from ds_sim.conditions.model import Conditions
from ds_sim.simulator import FRAME_TIME, Outcome

VERDICTS = tuple(outcome.name for outcome in Outcome if outcome.is_verdict)
TEST_COLUMNS = "test_id, sibling, run, number, control_points, seed, published, road_id"
EXECUTION_COLUMNS = (
    "test_id, simulator, outcome, message, fitness, max_lateral_position, steps, simulated_seconds, trajectory_sha256, "
    "trajectory, bag, steering"
)
_TOLERANCE = 1e-6
"""m and s, between a stored value and the value derived from other columns."""


def test_of(row: Row, lane: Side, conditions: Conditions) -> Test:
    """Make a test.

    Args:
        row: values of `TEST_COLUMNS`.
        lane: lane in which all roads of the campaign are driven.
        conditions: operating conditions of the test.

    Raises:
        RowError: no campaign can have written the row; the message names test and column.
    """
    test_id, sibling, run, number, points, seed, maxitwo_compatible, road_id = row
    try:
        sibling = check.text(sibling, "sibling")
        run, number = check.whole(run, "run"), check.whole(number, "number")
        if not check.file_name(test_id, "test_id").endswith(f"-{run}-{number:04d}"):
            raise check.RowError(f"test_id does not end in -{run}-{number:04d}")
        quirk = bool(check.whole(maxitwo_compatible, "published", high=1))
        road = Road(check.control_points(points), maxitwo_compatible=quirk, lane=lane)
        if road.road_id != road_id:
            raise check.RowError("road_id does not match the control points")
        return Test(
            test_id=test_id,
            sibling=sibling,
            run=run,
            number=number,
            road=road,
            seed=check.whole(seed, "seed"),
            conditions=conditions,
        )
    except ValueError as error:
        raise check.RowError(f"the test {test_id!r:.60}: {error}") from None


def execution_of(row: Row) -> Execution:
    """Make an execution of the values of `EXECUTION_COLUMNS`.

    Raises:
        RowError: no campaign can have written the row; the message names test, simulator and column.
    """
    try:
        steps = check.whole(row[6], "steps", high=check.MOST_STEPS)
        execution = Execution(
            test_id=check.text(row[0], "test_id"),
            simulator=check.text(row[1], "simulator"),
            outcome=Outcome[check.one_of(row[2], "outcome", VERDICTS)],
            message=check.text(row[3], "message"),
            fitness=check.real(row[4], "fitness"),
            max_lateral_position=check.real(row[5], "max_lateral_position"),
            steps=steps,
            simulated_seconds=check.real(row[7], "simulated_seconds"),
            trajectory_sha256=row[8],
            trajectory=check.unpack_trajectory(row[9], row[8], steps=steps),
            bag=check.bag_folder(row[10]),
            steering=check.unpack_numbers(row[11], "steering", count=steps),
        )
        if abs(execution.simulated_seconds - steps * FRAME_TIME) > _TOLERANCE:
            raise check.RowError(f"simulated_seconds is {execution.simulated_seconds:g} for {steps} steps")
        lateral = np.abs(execution.trajectory[:, 4])
        if lateral.size and abs(lateral.max() - execution.max_lateral_position) > _TOLERANCE:
            raise check.RowError("max_lateral_position does not match the trajectory")
        if np.abs(execution.steering).max(initial=0.0) > 1.0:
            raise check.RowError("steering leaves [-1, 1]")
        return execution
    except check.RowError as error:
        raise check.RowError(f"the run of {row[0]!s:.60} on {row[1]!s:.60} cannot be read: {error}") from None
