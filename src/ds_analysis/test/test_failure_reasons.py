# SPDX-License-Identifier: Apache-2.0
"""Reasons of failures on drives that were made with them, and choices that chance hardly makes."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from made_executions import made_execution
from statsmodels.stats.proportion import proportion_confint

from ds_analysis import failures
from ds_analysis.common.selection import ALPHA, Axis, Share, choose_split, most_frequent, p_of_leads
from ds_analysis.common.statistics import Array, Bools, Indices
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


SIZES = ((4, 3, 2, 2, 2, 1), (6, 5, 5, 3, 3, 3, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1))
FAMILIES = {sum(sizes): np.repeat(np.arange(len(sizes)), sizes) for sizes in SIZES}
"""Tests -> their families, of sizes that searches of these lengths have."""
CAMPAIGNS = 300


def as_axes(values: Array) -> list[Axis]:
    return [(str(k), of, 1) for k, of in enumerate(values)]


def values_of(families: Indices, axes: int, rng: np.random.Generator) -> Array:
    """Mutants are near their root: nine tenths of the variance lie between families, as in searches."""
    roots = rng.standard_normal((axes, families.max() + 1))
    return roots[:, families] + rng.standard_normal((axes, len(families))) / 3.0


def drawn(rate: Array, rng: np.random.Generator) -> Bools:
    return rng.random(len(rate)) < rate


@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize(("tests", "axes"), [(14, 3), (14, 12), (40, 3), (40, 12)])
def test_noise_is_stated_in_at_most_a_twentieth_of_campaigns(tests: int, axes: int, alike: bool) -> None:
    """Also where mutants of a road end alike, for reasons that no axis knows."""
    rng = np.random.default_rng([tests, axes, alike])
    families, stated = FAMILIES[tests], 0
    for _ in range(CAMPAIGNS):
        rate = rng.choice((0.05, 0.95), families.max() + 1)[families] if alike else np.full(tests, 0.3)
        split = choose_split(as_axes(values_of(families, axes, rng)), drawn(rate, rng), families, rng)
        stated += split is not None and split.is_clear
    assert stated / CAMPAIGNS <= ALPHA + 2.0 * np.sqrt(ALPHA * (1.0 - ALPHA) / CAMPAIGNS)


def test_a_clear_effect_is_found_and_its_shares_are_covered() -> None:
    rng = np.random.default_rng(1)
    families, stated, covered = FAMILIES[40], 0, np.zeros(2)
    for _ in range(CAMPAIGNS):
        values = values_of(families, 3, rng)
        # An axis of unit variance, and a tenth of it within families; the threshold is in the middle.
        rate = np.where(values[1] > 0.25, 0.9, 0.05)
        split = choose_split(as_axes(values), drawn(rate, rng), families, rng)
        if split is None or not split.is_clear or split.apart is None:
            continue
        stated += 1
        others = np.sqrt(1.0 + 1.0 / 9.0) * rng.standard_normal(2000)
        truth = np.where(others > 0.25, 0.9, 0.05) if split.axis == "1" else np.full(2000, 0.4)
        for side, share in enumerate(split.apart):
            low, high = share.interval
            covered[side] += low <= truth[(others >= split.threshold) == (side == 0)].mean() <= high
    assert stated / CAMPAIGNS > 0.8
    assert (covered / stated >= 0.95).all()


def test_p_is_the_share_of_all_orders_of_the_families() -> None:
    """Against every permutation of six families of one size, by hand."""
    rng = np.random.default_rng(2)
    families, failed = np.repeat(np.arange(6), 2), np.array([0, 1, 0, 0, 1, 1, 0, 0, 1, 0, 1, 1], np.bool_)
    place = np.array([3.0, 1.0, 5.0, 0.0, 2.0, 4.0])
    failures = np.bincount(families, failed)

    def largest(order: tuple[int, ...]) -> float:
        by_place = failures[list(order)][np.argsort(-place)]
        return max(by_place[:k].sum() / 6 - (2 * k - by_place[:k].sum()) / 6 for k in range(1, 6))

    every = [largest(order) for order in permutations(range(6))]
    split = choose_split([("", place[families], 1)], failed, families, rng)
    assert split is not None
    assert split.p == pytest.approx(np.mean(np.array(every) >= every[0] - 1e-9), abs=0.08)
    assert every[0] == largest((0, 1, 2, 3, 4, 5))


def test_tests_that_end_alike_have_no_split() -> None:
    rng = np.random.default_rng(1)
    for failed in (np.ones(9, np.bool_), np.zeros(9, np.bool_)):
        assert choose_split([("", np.arange(9.0), 1)], failed, np.arange(9), rng) is None
    assert choose_split(as_axes(np.ones((2, 9))), np.arange(9) > 3, np.arange(9), rng) is None


def test_families_make_intervals_wider() -> None:
    failed = np.arange(24) % 4 == 0
    alone = Share.of(failed, np.arange(24)).interval
    assert alone == pytest.approx(proportion_confint(6, 24, method="beta"))
    together = Share.of(np.repeat([True, False, False, False] * 2, 3), np.repeat(np.arange(8), 3)).interval
    assert together[1] - together[0] > 1.3 * (alone[1] - alone[0])
    # Where all end alike, a family counts as one test.
    alike = Share.of(np.ones(24, np.bool_), np.arange(24) // 3).interval
    assert alike == pytest.approx(proportion_confint(8, 8, method="beta"))


def test_the_best_of_three_is_named_only_if_its_lead_is_no_accident() -> None:
    rng = np.random.default_rng(4)
    named = 0
    for _ in range(CAMPAIGNS):
        agrees = rng.random((3, 12)) < 0.5
        named += bool((p_of_leads(np.where(agrees, 1.0, -1.0), np.arange(12)) <= ALPHA).any())
    assert named / CAMPAIGNS <= 0.05 + 2.0 * np.sqrt(0.05 * 0.95 / CAMPAIGNS)
    assert p_of_leads(np.ones((1, 12)), np.arange(12))[0] == pytest.approx(1 / 2000, abs=1e-3)


def test_a_label_leads_only_if_the_second_is_clearly_rarer() -> None:
    alone = np.arange(24)
    assert most_frequent(["wide"] * 18 + ["cuts"] * 6, alone) == "wide"
    assert most_frequent(["wide"] * 13 + ["cuts"] * 11, alone) is None
    # The eighteen descend from three roads, the six from one.
    assert most_frequent(["wide"] * 18 + ["cuts"] * 6, alone // 6) is None
    assert most_frequent(["wide"] * 3, np.arange(3)) == "wide" and most_frequent([], np.arange(0)) is None


def test_shares_are_measured_by_the_splits_of_other_families() -> None:
    families = np.arange(20)
    values, failed = np.arange(20.0)[None], np.arange(20) >= 12
    split = choose_split(as_axes(values), failed, families, np.random.default_rng(1))
    assert split is not None and split.is_clear and split.apart is not None
    assert split.threshold == 12.0 and split.harder.tolist() == failed.tolist()
    # Without test 12, whose value decides, the others call harder what is 13 or more.
    assert [(one.failures, one.tests) for one in split.apart] == [(7, 7), (1, 13)]
