# SPDX-License-Identifier: Apache-2.0
"""Reasons of failures, on drives whose cause is known because they were made with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_executions import made_execution

from ds_analysis import failures
from ds_analysis.common.statistics import Array
from ds_analysis.failures import groups_of, reason_of, reasons_of, where
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.store.model import DriveArrays, Execution, Origin, Test
from ds_road import Road
from ds_sim import BULLET
from ds_sim.conditions.model import Conditions
from ds_sim.oracle import LaneTracker
from ds_sim.scenario import Scenario
from ds_sim.simulator import FRAME_TIME, Outcome

RIGHT = Road([(100, 0), (100, 25), (100, 50), (100, 75), (118, 93), (143, 93), (168, 93)])
"""Straight on for some 50 m, then a bend to the right."""
LEFT = Road([(200 - x, y) for x, y in RIGHT.control_points])
SPEED = 6.0


def failed(
    path: Array, steering: Array, road: Road, *, outcome: Outcome = Outcome.OUT_OF_BOUNDS, speed: float = SPEED
) -> Execution:
    """A drive along a path, which ends where it leaves the lane."""
    tracker = LaneTracker(road.lane_centre)
    lateral = np.array([tracker.update(x, y)[0] for x, y in path])
    out = np.flatnonzero(np.abs(lateral) > road.lane_width / 2)
    end = int(out[0]) + 1 if len(out) else len(path)
    assert outcome is not Outcome.OUT_OF_BOUNDS or len(out)
    columns = np.column_stack((path, np.zeros(len(path)), np.full(len(path), speed), lateral))[:end]
    largest = float(np.abs(columns[:, 4]).max())
    drive = DriveArrays(columns, steering[: end - 1])
    return made_execution("bullet-0-0000", "bullet", outcome, largest, steps=end - 1, drive=drive)


def made_test(road: Road, **conditions: float) -> Test:
    return Test("bullet-0-0000", Scenario(road, Conditions(**conditions), seed=1), Origin(BULLET, 0, 0))


def straight_on(road: Road) -> Array:
    start = road.lane_centre[0]
    return start + np.arange(0.0, 80.0, SPEED * FRAME_TIME)[:, None] * np.array([0.0, 1.0])


def drifting(road: Road) -> Array:
    """To the left, by 3 cm a frame."""
    path = straight_on(road)
    return path - np.column_stack((0.03 * np.arange(len(path)), np.zeros(len(path))))


def steering_from(arc: float, amount: float, noise: float = 0.01) -> Array:
    """Nothing up to an arc length, then an amount."""
    arcs = np.arange(0.0, 80.0, SPEED * FRAME_TIME)
    return np.where(arcs < arc, 0.0, amount) + noise * np.sin(np.arange(len(arcs)))


def first_bend(road: Road, sign: float = 1.0) -> float:
    """Where the lane turns right (1) or left (-1) as in a radius of 50 m, from the headings of its steps alone."""
    step = np.diff(road.lane_centre, axis=0)
    lengths = np.hypot(*step.T)
    turning = -sign * np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0]))) / lengths[1:]
    return float(lengths.cumsum()[np.argmax(turning > 1.0 / 50.0)])


@pytest.mark.parametrize(("road", "side"), [(RIGHT, "right"), (LEFT, "left")])
def test_a_car_that_goes_straight_on_in_a_bend_is_late_wrong_or_weak(road: Road, side: str) -> None:
    sign = 1.0 if side == "right" else -1.0
    bend = first_bend(road, sign)
    path = straight_on(road)
    leaves = len(failed(path, np.zeros(len(path)), road).steering) * SPEED * FRAME_TIME
    cases = {
        "steers late": steering_from(leaves - 2.0, sign * 0.4),
        "steers the wrong way": steering_from(bend - 2.0, -sign * 0.4),
        "steers in, then lets go": steering_from(bend - 2.0, sign * 0.3) + steering_from(leaves - 4.0, -sign * 0.5),
        "steers in time, but too little": steering_from(bend - 2.0, sign * 0.05),
    }
    for led, steering in cases.items():
        reason = reason_of(made_test(road), failed(path, steering, road))
        assert reason.kind == f"runs wide in a {side} bend: it {led}"
    late = reason_of(made_test(road), failed(path, cases["steers late"], road))
    seconds = float(late.details.partition("steers ")[2].split()[0])
    assert seconds == pytest.approx((leaves - 2.0 - bend) / SPEED, abs=0.5)


def test_cutting_straight_slow_and_odd_commands_are_told_apart() -> None:
    noise = steering_from(0.0, 0.3)
    lane, across = RIGHT.lane_centre, (RIGHT.right_edge - RIGHT.left_edge) / (4 * RIGHT.lane_width / 2)
    along = np.concatenate(([0.0], np.hypot(*np.diff(lane, axis=0).T).cumsum()))
    cut = lane + np.clip((along - first_bend(RIGHT) - 8.0) / 3.0, 0.0, 3.0)[:, None] * across
    assert reason_of(made_test(RIGHT), failed(cut, noise, RIGHT)).kind == "cuts a right bend: it steers too much"
    drift = drifting(RIGHT)
    straight = reason_of(made_test(RIGHT, visibility=40.0), failed(drift, noise, RIGHT))
    assert straight.kind == "leaves a straight"
    assert straight.details.endswith(", in fog or haze with a visibility of 40 m (visibility)")
    locked = np.where(np.arange(300) % 3 > 0, 1.0, -0.2)
    for steering, led in ((np.full(300, 0.3), "always steers the same"), (locked, "is at full lock half of the time")):
        assert reason_of(made_test(RIGHT), failed(drift, steering, RIGHT)).kind == f"leaves a straight: it {led}"
    slow = failed(straight_on(RIGHT)[:100], noise, RIGHT, outcome=Outcome.TIMEOUT, speed=0.9)
    found = reason_of(made_test(RIGHT), slow)
    assert found.kind == "is too slow to finish: it crawls" and "3 km/h" in found.details
    assert reason_of(made_test(RIGHT), replace(slow, outcome=Outcome.STUCK)).kind == "stops on the road: it crawls"


def test_the_largest_group_comes_first_and_large_campaigns_are_sampled(monkeypatch: pytest.MonkeyPatch) -> None:
    path = straight_on(RIGHT)
    wide, straight = (
        failed(path, steering_from(40.0, -0.4), RIGHT),
        failed(drifting(RIGHT), steering_from(0.0, 0.2), RIGHT),
    )
    # The same road under the same conditions would count once.
    tests = [replace(made_test(RIGHT, visibility=50.0 + k), test_id=f"bullet-0-{k:04d}") for k in range(9)]
    executions = [replace(straight if k == 0 else wide, test_id=test.test_id) for k, test in enumerate(tests)]
    config = CampaignConfig(siblings=[BULLET], driver=AUTOPILOT)
    data = CampaignData(config=config, tests=tuple(tests), executions=tuple(executions))
    groups = groups_of(reasons_of(data))
    assert [where(group) for group in groups.values()] == ["8 on bullet", "1 on bullet"]
    monkeypatch.setattr(failures, "MOST_FAILURES", 3)
    assert [reason.test_id[-1] for reason in reasons_of(data)] == ["0", "3", "6"]
