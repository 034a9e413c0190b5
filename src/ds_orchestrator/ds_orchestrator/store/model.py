"""Values that a campaign's store keeps: tests and their outcomes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

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
        trajectory: (steps + 1, 5) float64: x, y, yaw, speed, lateral position; m, rad, m/s.
        bag: folder of the bag relative to the campaign folder, or "".
        steering: (steps,) float64, the commands in [-1, 1].
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
    trajectory: NDArray[np.float64]
    bag: str = ""
    steering: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
