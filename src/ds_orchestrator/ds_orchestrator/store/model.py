"""Values that a campaign's store keeps: tests and their outcomes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_orchestrator.search.features import Drive
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.simulator import Outcome


@dataclass(frozen=True, kw_only=True)
class Test:
    """Road, with operating conditions, that the search generated on one sibling.

    Attributes:
        test_id: `<sibling>-<run>-<number>`.
        sibling: simulator whose search generated the road.
        run: index of the search run, from 0.
        number: index of the test within the run, from 0.
        road: road to drive.
        seed: seed of every execution of this test.
        conditions: operating conditions of every execution of this test.
    """

    __test__ = False  # not a test case for pytest

    test_id: str
    sibling: str
    run: int
    number: int
    road: Road
    seed: int
    conditions: Conditions = DEFAULT


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


@dataclass(frozen=True, kw_only=True)
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
