# SPDX-License-Identifier: Apache-2.0
"""What a sibling adds, on outcomes whose information is known, how failures leave the lane, how simulators agree."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from made_executions import made_execution
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score
from statsmodels.stats.proportion import proportion_confint

from ds_analysis.common.cross_validation import auc_roc_by_ranks, predict_failures
from ds_analysis.common.driven_road import GRID, DrivenRoad, lateral_profile
from ds_analysis.common.outcome_table import ROAD_FEATURES, RoadTable, State, table_of_runs
from ds_analysis.failure_patterns import KINDS, Departure, departure, departures_of, nestings
from ds_analysis.siblings.analysis import (
    SiblingAnalysis,
    analyse,
    analysis_tables,
    compare,
    gaps,
    most_different,
    summary,
)
from ds_analysis.siblings.beyond_features import AddedInformation, baseline_of, information_about, residual_correlations
from ds_analysis.siblings.track_answer import TrackAnswer
from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.executor import execution_of
from ds_orchestrator.store.model import Execution
from ds_report.sections import draw_failures, draw_matrix
from ds_road import MutationError, Road, generate, mutate
from ds_road.geometry import lane_curvature
from ds_sim import DONKEY
from ds_sim.conditions.model import Conditions
from ds_sim.registry import SOFTBODY, SimulatorName, make_simulator
from ds_sim.simulator import Command, Observation, Outcome
from ds_sim.testing import STRAIGHT

A_NAME, B_NAME, TWIN = map(SimulatorName, ("a", "b", "twin"))

Array = NDArray[np.float64]
ROADS = tuple(generate(np.random.default_rng(seed)) for seed in range(60))
RIGHT = np.array([road.lane_curvature_max_right for road in ROADS])
HARD = np.quantile(RIGHT, 0.7)


def made_up(
    lateral: dict[str, Array],
    *,
    profiles: dict[str, Sequence[Array]] | None = None,
    roads: Sequence[Road] = ROADS,
    conditions: Sequence[Conditions] | None = None,
) -> RoadTable:
    """Outcomes of runs that fail where the largest lateral position is 2 m or more."""
    together = np.column_stack(list(lateral.values()))
    drives = None
    if profiles is not None:
        rows = zip(roads, *profiles.values(), strict=False)
        drives = [[DrivenRoad(road=road, outcome=Outcome.COMPLETED, profile=one) for one in of] for road, *of in rows]
    return RoadTable.of(
        roads[: len(together)],
        states_of(together >= 2.0),
        together,
        siblings=tuple(map(SimulatorName, lateral)),
        drives=drives,
        conditions=conditions,
    )


def states_of(failed: NDArray[np.bool_]) -> NDArray[np.int8]:
    return np.where(failed, State.FAILED, State.COMPLETED).astype(np.int8)


def noise(seed: int) -> Array:
    return np.random.default_rng(seed).normal(size=len(ROADS))


def test_a_feature_that_decides_is_found_on_other_roads_and_leaves_nothing_to_add() -> None:
    """Outcomes are functions of one feature, each simulator with a threshold of its own."""
    found = analyse(made_up({"a": 2 * RIGHT / (0.9 * HARD), "twin": 2 * RIGHT / HARD}), [TWIN], repeats=1)
    for one in found.baselines:
        assert one.best is not None and one.all is not None and not one.caution
        assert one.best.auc > 0.98 and one.chosen == {"lane_curvature_max_right": 1.0}
        assert one.best.brier < 0.06 and one.best.bits < 0.25 < one.entropy
    (added,) = found.information
    assert added.bits is not None and abs(added.bits) < 0.03 and added.verdict == "nothing shown"
    assert found.feature == "lane_curvature_max_right"


def test_a_sibling_that_equals_the_twin_adds_what_the_features_leave() -> None:
    """Outcomes that no feature predicts: one bit of entropy, all of it in the sibling. A second one adds nothing."""
    lateral = np.where(noise(1) > 0, 2.5, 0.5)
    outcomes = made_up({"same": lateral, "again": lateral, "twin": lateral})
    base = baseline_of(outcomes, TWIN, repeats=1)
    assert base.entropy == pytest.approx(1.0, abs=0.03)
    assert base.all is not None and base.all.bits == pytest.approx(1.0, abs=0.15) and base.all.auc < 0.75
    first, second = information_about(outcomes, TWIN, [SimulatorName("same"), SimulatorName("again")], repeats=1)
    assert first.bits is not None and first.left is not None and first.interval is not None
    assert first.bits == pytest.approx(first.left, abs=0.25) and first.verdict == "adds information"
    assert first.interval[0] > 0.5
    assert second.bits is not None and abs(second.bits) < 0.1 and second.beyond == ("same",)
    assert f"same adds {first.bits:.3f} bits" in first.sentence and "about twin beyond features: adds" in first.sentence
    assert "beyond features and same: " in second.sentence


def test_a_sibling_of_noise_is_not_said_to_add_anything() -> None:
    """Three of them, beside a twin that fails by a feature and by chance."""
    twin = 2 * RIGHT / HARD + 0.15 * noise(2)
    for seed in range(10, 13):
        outcomes = made_up({"a": 2 + noise(seed), "twin": twin})
        assert information_about(outcomes, TWIN, [A_NAME], repeats=1)[0].verdict == "nothing shown"


def test_a_condition_that_decides_is_a_feature() -> None:
    """The twin and a sibling fail where lines are faint; the roads' shapes say nothing."""
    contrasts = np.random.default_rng(6).uniform(0.05, 1.0, len(ROADS))
    lateral = 2 * 0.4 / contrasts
    plain = made_up({"a": lateral, "twin": 1.1 * lateral})
    conditions = [Conditions(line_contrast=one) for one in contrasts.tolist()]
    outcomes = made_up({"a": lateral, "twin": 1.1 * lateral}, conditions=conditions)
    assert outcomes.feature_names == (*ROAD_FEATURES, "line_contrast")
    blind, seeing = baseline_of(plain, TWIN, repeats=1), baseline_of(outcomes, TWIN, repeats=1)
    assert blind.best is not None and seeing.best is not None
    assert blind.best.auc < 0.7 and seeing.best.auc > 0.98 and seeing.chosen == {"line_contrast": 1.0}
    assert information_about(plain, TWIN, [A_NAME], repeats=1)[0].verdict == "adds information"
    assert information_about(outcomes, TWIN, [A_NAME], repeats=1)[0].verdict == "nothing shown"
    assert draw_failures(outcomes, "line_contrast").shape == (460, 1140, 3)


def test_roads_are_predicted_from_other_families_than_their_own() -> None:
    """Near copies of 12 roads, and outcomes that are chance for each family: copies would give them away."""
    rng = np.random.default_rng(8)
    roads = []
    for root in ROADS[:12]:
        roads.append(root)
        while len(roads) % 8:
            with suppress(MutationError):
                roads.append(mutate(root, rng))
    fails = np.repeat(np.arange(12) % 2 == 0, 8)
    lateral = np.where(fails, 2.5, 0.5)[:, None] + 0.01 * rng.normal(size=(96, 2))
    outcomes = made_up({"a": lateral[:, 0], "twin": lateral[:, 1]}, roads=roads)
    assert sorted(np.bincount(outcomes.families)) == [8] * 12
    leaking = predict_failures(outcomes.features, fails, repeats=1).probability[0]
    honest = baseline_of(outcomes, TWIN, repeats=1)
    assert honest.all is not None and honest.all.auc_interval is not None
    assert roc_auc_score(fails, leaking) > 0.85 and honest.all.auc < 0.7
    # A dozen coins: the interval is that of 12 families, far wider than that of 96 roads.
    low, high = honest.all.auc_interval
    assert high - low > 0.3
    few = replace(outcomes, states=states_of(np.column_stack([np.arange(96) // 8 < 4] * 2)))
    assert "roads of 4 families of mutants fail on twin, of 8 do not" in baseline_of(few, TWIN).caution


def test_too_few_failures_are_too_few_to_say() -> None:
    lateral = np.where(np.arange(60) < 9, 2.5, 0.5)
    found = analyse(made_up({"a": lateral[::-1], "twin": lateral}), [TWIN])
    assert all(one.best is None and one.all is None and not one.chosen for one in found.baselines)
    assert "9 of 60 roads fail on twin, expected 10 that fail and 10 that do not" in found.baselines[1].caution
    (added,) = found.information
    assert (added.bits, added.interval, added.verdict) == (None, None, "too few")
    assert added.sentence.startswith("what a adds about twin beyond features: too few failures to say: 9 of 60")
    assert found.residuals[0].roads is None and found.residuals[0].plain is not None
    for table in analysis_tables(found):
        assert table.texts() and table.latex() and table.csv()
    json.dumps(found.document(), allow_nan=False)
    nothing = analyse(made_up({"a": lateral[:0], "twin": lateral[:0]}), [A_NAME, TWIN])
    assert nothing.residuals[0].plain is None and "0 roads, expected 20" in nothing.residuals[0].caution


def test_no_prediction_depends_on_the_outcome_that_it_predicts() -> None:
    """Outcomes of chance have no area beyond chance, however many features there are to choose from."""
    rng = np.random.default_rng(5)
    areas = []
    for _ in range(4):
        features, failed = rng.normal(size=(60, 30)), rng.random(60) < 0.5
        probability = predict_failures(features, failed, columns=("best",), repeats=1).probability[0]
        areas.append(roc_auc_score(failed, probability))
        assert auc_roc_by_ranks(probability, failed) == pytest.approx(areas[-1], abs=1e-12)
    assert np.mean(areas) < 0.6


def test_what_two_simulators_share_beyond_the_feature_is_their_residual_correlation() -> None:
    shared = noise(6)
    beyond = {"a": shared, "b": shared, "c": noise(7)}
    outcomes = made_up({name: 1.9 * RIGHT / HARD + 0.15 * own for name, own in beyond.items()})
    same, apart, _ = residual_correlations(outcomes, repeats=1)
    assert same.roads == pytest.approx(1.0) and same.roads_interval is None  # of no width: 1 in every resample
    assert apart.plain is not None and apart.plain > 0.7
    assert apart.roads is not None and apart.roads_interval is not None
    assert abs(apart.roads) < 0.35 and apart.roads_interval[0] < 0.0 < apart.roads_interval[1]


def test_per_place_what_curvature_explains_is_taken_out() -> None:
    """Positions are a function of the curvature at the place, plus a part that two of three simulators share."""
    rng = np.random.default_rng(8)
    profiles: dict[str, list[Array]] = {"a": [], "b": [], "c": []}
    for road in ROADS[:30]:
        bend = 3.0 * lane_curvature(road.lane_centre, GRID * np.arange(1.0, 200.0))
        shared = 0.3 * rng.normal(size=199)
        profiles["a"].append(bend + shared)
        profiles["b"].append((bend + shared)[:150])
        profiles["c"].append(bend + 0.3 * rng.normal(size=199))
    outcomes = made_up({name: np.full(30, 0.5) for name in "abc"}, profiles=dict(profiles))
    same, apart, _ = residual_correlations(outcomes, repeats=1)
    assert same.places is not None and same.places > 0.97
    assert apart.places is not None and abs(apart.places) < 0.06
    assert apart.places_interval is not None and np.ptp(apart.places_interval) < 0.15
    assert same.plain is None


def test_nesting_is_a_share_with_the_interval_of_clopper_and_pearson() -> None:
    """20 roads fail on both, 5 on the first alone, 10 on the second alone."""
    verdicts = [(2.5, 2.5)] * 20 + [(2.5, 0.5)] * 5 + [(0.5, 2.5)] * 10 + [(0.5, 0.5)] * 15
    one, other = np.array(verdicts).T
    (found,) = nestings(made_up({"a": one, "b": other}))
    assert (found.both, found.only_first, found.only_second, found.neither) == (20, 5, 10, 15)
    assert (found.second_given_first, found.first_given_second) == (20 / 25, 20 / 30)
    assert found.second_given_first_interval == pytest.approx(proportion_confint(20, 25, method="beta"))
    assert found.first_given_second_interval == pytest.approx(proportion_confint(20, 30, method="beta"))
    (never,) = nestings(made_up({"a": np.full(3, 0.5), "b": np.full(3, 2.5)}))
    assert never.second_given_first is None and never.second_given_first_interval is None
    assert never.first_given_second == 0.0 and never.first_given_second_interval is not None


def test_nesting_of_near_copies_is_that_of_their_families() -> None:
    """Of 4 copies each of 10 roads all fail on both simulators: 10 observations, not 40."""
    copies = tuple(ROADS[k // 4] for k in range(40))
    alike = np.full((40, 2), True)
    apart = alike & np.column_stack((np.arange(40) >= 0, np.arange(40) // 4 > 1))
    made = made_up({"a": np.full(40, 2.5), "b": np.full(40, 2.5)}, roads=copies)
    for failed, ends in ((alike, proportion_confint(10, 10, method="beta")), (apart, (0.5, 1.0))):
        (found,) = nestings(replace(made, states=states_of(failed)))
        assert found.second_given_first == failed[:, 1].mean()
        assert found.second_given_first_interval == pytest.approx(ends, abs=0.05)


def test_nesting_of_a_single_family_counts_as_one_observation() -> None:
    """Two mutants of one road fail on one simulator, one of them on the other: there is no family to resample."""
    copies = tuple(ROADS[0] for _ in range(10))
    failed = np.column_stack((np.arange(10) < 2, np.arange(10) < 1))
    made = made_up({"a": np.full(10, 2.5), "b": np.full(10, 2.5)}, roads=copies)
    (found,) = nestings(replace(made, states=states_of(failed)))
    assert found.second_given_first == 0.5 and found.second_given_first_interval == pytest.approx((0.0, 0.975))


def test_the_first_sentence_names_who_adds_something() -> None:
    def adds(sibling: str, low: float) -> AddedInformation:
        return AddedInformation(
            about="car", sibling=SimulatorName(sibling), beyond=(), caution="", bits=0.1, interval=(low, 0.2)
        )

    def said(*information: AddedInformation) -> list[str]:
        return SiblingAnalysis(departures=[], nesting=[], baselines=[], residuals=[], information=information).answer

    both = said(adds("a", 0.05), adds("b", -0.1), adds("c", -0.1))
    start = "a adds information about car beyond road features"
    assert both == [f"{start}; nothing is shown that b and c would add about car."]
    assert said(adds("a", 0.05)) == [f"{start}."]
    assert said(adds("a", -0.05)) == ["nothing is shown that a would add about car."]
    few = AddedInformation(about="car", sibling=A_NAME, beyond=(), caution="too few")
    assert said(few) == ["Whether a sibling adds anything about car is open: too few."]


def test_the_pictures_show_every_road_of_every_simulator() -> None:
    """One more failure recolours its column in its simulator's row and its point in its panel, and nothing else."""
    lateral = np.where(RIGHT > HARD, 2.5, 0.5)
    changed = lateral.copy()
    changed[int(np.argmin(RIGHT))] = 2.5
    feature = "lane_curvature_max_right"
    before, after = (made_up({"a": lateral, "b": other}) for other in (lateral, changed))
    one, other = draw_matrix(before, feature), draw_matrix(after, feature)
    rows, columns = np.nonzero((one != other).any(axis=2))
    middle = one.shape[0] // 2
    assert middle - 20 <= rows.min() <= rows.max() < middle + 40 and columns.max() - columns.min() < 25
    one, other = draw_failures(before, feature), draw_failures(after, feature)
    rows, columns = np.nonzero((one != other).any(axis=2))
    assert rows.min() >= 210 and one.shape == other.shape == (460, 1140, 3)
    np.testing.assert_array_equal(other, draw_failures(after, feature))


def test_a_stored_drive_is_compared_as_its_run_to_the_bit() -> None:
    simulator = make_simulator("softbody")
    run = drive_road(simulator, make_driver("autopilot", simulator.spec), ROADS[0], 1)
    simulator.close()
    one, other = DrivenRoad.of_run(run), DrivenRoad.of_execution(ROADS[0], execution_of("t", SOFTBODY, run))
    assert (one.road, one.outcome, one.max_lateral_position) == (other.road, other.outcome, other.max_lateral_position)
    assert len(one.profile) > 200 and one.profile.tobytes() == other.profile.tobytes()
    assert one.path.tobytes() == other.path.tobytes()


RIGHT_BEND = Road([(60, 20), (60, 45), (60, 70), (70, 92), (92, 102), (117, 102), (142, 102), (167, 102)])
"""25 m straight on to the north, then right to the east with a radius of about 25 m, then straight on."""
IN_BEND, ON_STRAIGHT = 38.0, 8.0
MIRRORED: dict[Departure, Departure] = {
    "wide in a right bend": "wide in a left bend",
    "cuts a right bend": "cuts a left bend",
    "right, straight on": "left, straight on",
}


def leave(road: Road, steering: float, after: float) -> DrivenRoad:
    """Drive by the autopilot, and from an arc length on with additional steering, right positive."""
    simulator = make_simulator("softbody")
    autopilot = make_driver("autopilot", simulator.spec)

    def steer(seen: Observation) -> Command:
        found = autopilot(seen)
        away = steering if seen.lane.arc_length >= after else 0.0
        return Command(float(np.clip(found.steering + away, -1.0, 1.0)), found.throttle)

    run = drive_road(simulator, steer, road, 1)
    simulator.close()
    return DrivenRoad.of_run(run)


@pytest.mark.parametrize(
    ("steering", "after", "kind"),
    [
        (-0.8, IN_BEND, "wide in a right bend"),
        (0.8, IN_BEND, "cuts a right bend"),
        (0.8, ON_STRAIGHT, "right, straight on"),
    ],
)
def test_a_drive_that_is_steered_out_of_its_lane_leaves_it_there(
    steering: float, after: float, kind: Departure
) -> None:
    runs = [leave(RIGHT_BEND, steering, after), leave(RIGHT_BEND.mirrored(), -steering, after)]
    assert [run.outcome for run in runs] == [Outcome.OUT_OF_BOUNDS] * 2
    for run, expected in zip(runs, (kind, MIRRORED[kind]), strict=True):
        (found,) = departures_of(table_of_runs({SOFTBODY: [run]}))
        assert found.failures == 1 and [name for name in KINDS if found.counts[name]] == [expected]


def test_failures_in_the_lane_stay_in_it_and_the_table_counts_each_failure_once() -> None:
    assert departure(RIGHT_BEND, np.full(60, 1.0), 1.0) == "stays in the lane"
    assert departure(RIGHT_BEND, np.empty(0), 2.0) == "not recorded"
    out, kept = leave(RIGHT_BEND, 0.8, IN_BEND), leave(RIGHT_BEND, 0.0, IN_BEND)
    assert kept.outcome is Outcome.COMPLETED
    found = analyse(table_of_runs({A_NAME: [out, kept], B_NAME: [kept, kept]}), [B_NAME], repeats=1)
    table = analysis_tables(found)[0]
    assert table.name == "sibling_departures" and [row[0] for row in table.rows] == ["a", "b"]
    assert [sum(row[2:]) for row in table.rows] == [row[1] for row in table.rows] == [1, 0]  # type: ignore[arg-type]
    assert found.document()["departures"][0]["counts"]["cuts a right bend"] == 1


def run(
    outcome: Outcome = Outcome.COMPLETED, lateral: tuple[float, float] = (0.0, 0.0), length: float = 50.0
) -> DrivenRoad:
    """Create a run whose lateral position changes linearly between two values; its speed varies."""
    shares = np.linspace(0.0, 1.0, 21) ** 2
    positions = lateral[0] + shares * (lateral[1] - lateral[0])
    return DrivenRoad(
        road=STRAIGHT,
        outcome=outcome,
        max_lateral_position=float(np.abs(positions).max()),
        profile=lateral_profile(shares * length, positions, STRAIGHT.lane_width / 2),
    )


def test_kappa_is_that_of_the_textbook_table() -> None:
    """20 and 15 agreements of 50, 5 and 10 disagreements: observed 0.7, by chance 0.5, kappa 0.4."""
    fail, drive = Outcome.OUT_OF_BOUNDS, Outcome.COMPLETED
    verdicts = [(fail, fail)] * 20 + [(fail, drive)] * 5 + [(drive, fail)] * 10 + [(drive, drive)] * 15
    verdicts += [(Outcome.DRIVER_SILENT, fail), (drive, Outcome.SIM_ERROR)]
    found = compare(table_of_runs({A_NAME: [run(v[0]) for v in verdicts], B_NAME: [run(v[1]) for v in verdicts]}))[0]
    assert (found.both_fail, found.only_first_fails, found.only_second_fails, found.both_complete) == (20, 5, 10, 15)
    assert found.roads == 50 and found.kappa == pytest.approx(0.4)
    # Asymptotic standard error by Fleiss, Cohen and Everitt for this table: 0.127.
    assert found.kappa_interval is not None
    assert found.kappa_interval == pytest.approx((0.4 - 1.96 * 0.127, 0.4 + 1.96 * 0.127), abs=0.005)
    assert summary([run(v[1]) for v in verdicts])["errors"] == 1
    assert summary([run(v[0]) for v in verdicts])["success_rate"] == 26 / 51
    assert summary([run(Outcome.SIM_ERROR)])["success_rate"] is None


def test_where_there_is_no_kappa_it_says_why() -> None:
    runs = [run(), run(Outcome.STUCK)]
    assert compare(table_of_runs({A_NAME: [run(), run()], B_NAME: runs}))[0].reason.startswith("a completes every road")
    assert compare(table_of_runs({A_NAME: runs, B_NAME: [run(Outcome.STUCK)] * 2}))[0].reason.startswith(
        "b fails every road"
    )
    nothing = compare(table_of_runs({A_NAME: [run(Outcome.SIM_ERROR)], B_NAME: [run()]}))[0]
    assert nothing.roads == 0 and nothing.kappa is None and nothing.median_apart is None
    assert nothing.reason == "no road was driven to a verdict on both"


def test_lateral_positions_are_compared_at_the_same_places() -> None:
    """One drifts to 1 m, the other to -1 m over 50 m: 0.04 m apart per metre, 2 m at the end."""
    one, other = run(lateral=(0.0, 1.0)), run(lateral=(0.0, -1.0))
    assert gaps(one.profile, other.profile) == pytest.approx(0.04 * np.arange(0.5, 50.0, 0.5))
    found = compare(table_of_runs({A_NAME: [one], B_NAME: [other]}))[0]
    assert found.median_apart == pytest.approx(1.0)
    assert found.most_apart == pytest.approx(1.98)
    assert found.share_apart == pytest.approx(0.75, abs=0.01)
    assert found.correlation == pytest.approx(-1.0)
    # A shorter run is compared as far as it went; a car far off the road counts as at the lane's edge.
    assert len(gaps(one.profile, run(length=20.0).profile)) == 39
    assert gaps(run(lateral=(9.0, 9.0)).profile, run().profile).max() == 2.0
    assert most_different(table_of_runs({A_NAME: [run(), one, one], B_NAME: [run(), run(), other]}), 2) == [2, 1]


SEEN = SimulatorName("recording@x")
TRACK = [Road([(125, 0), (125, 25), (125, 50), (140 + k, 75)]) for k in range(3)]


def drives(outcomes: str) -> list[Execution | None]:
    """Letters: completed, left its lane, stuck, unknown."""
    kinds = {"c": Outcome.COMPLETED, "l": Outcome.OUT_OF_BOUNDS, "s": Outcome.STUCK}
    return [made_execution("t", SEEN, kinds[one]) if one != "u" else None for one in outcomes]


MINE = DriverName("mine")


def answer(own: str, *, twin: str = "ccc", autopilot: str = "ccc") -> TrackAnswer:
    return TrackAnswer(
        driver=MINE,
        recording=SEEN,
        twin=DONKEY,
        roads=TRACK,
        drives={
            (MINE, SEEN): drives(own),
            (MINE, DONKEY): drives(twin),
            (AUTOPILOT, SEEN): drives(autopilot),
            (AUTOPILOT, DONKEY): drives("ccc"),
        },
        undecided={(MINE, name): ["the car is far"] * of.count("u") for name, of in ((SEEN, own), (DONKEY, twin))},
        recorded=[True, False, False],
        limits=["The twin is not fitted."],
    )


@pytest.mark.parametrize(
    ("own", "verdict", "begin"),
    [
        ("ccc", "passes", "mine leaves its lane on 0 of the 3 roads of the recorded track ("),
        ("lcl", "fails", "mine leaves its lane on 2 of the 3 roads of the recorded track ("),
        ("lsc", "fails", "mine leaves its lane on 1 of the 3 roads of the recorded track, and on 1 it stands still"),
        ("ucc", "undecided", "mine leaves its lane on 0 of the 2 roads of the recorded track, while 1 more have no"),
        ("ulc", "fails", "mine leaves its lane on 1 of the 2 roads of the recorded track, while 1 more have no"),
    ],
)
def test_the_sentence_counts(own: str, verdict: str, begin: str) -> None:
    found = answer(own)
    assert found.verdict == verdict
    assert found.sentence.startswith(begin)
    assert found.document()["verdict"] == verdict and len(found.document()["roads"]) == 3


def test_it_names_what_to_compare_with() -> None:
    assert answer("lcc", twin="llc", autopilot="scc").sentence.endswith(
        "(the recorded drive left it on 1 of 3, the autopilot fails on 1 of 3; on the twin mine fails on 2 of 3 and "
        "autopilot fails on 0 of 3)."
    )


def test_what_could_not_be_done_comes_first() -> None:
    cautions = answer("ucc", twin="uuu", autopilot="lcc").cautions
    assert cautions[0] == "The twin is not fitted."
    assert cautions[1] == "On recording@x 1 road without a verdict, such as: the car is far."
    assert cautions[2].startswith("One simulator only: no drive on donkey has a verdict")
    assert cautions[3].startswith("The autopilot, which sees no image, fails on 1 road of the recording, too")
    assert replace(answer("ccc"), limits=()).cautions == []
