# SPDX-License-Identifier: Apache-2.0
"""A few drives on a real car: which are chosen, what is certain after them, and what is refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prediction_tables import ROAD, real_drive, table_of_margins

from ds_analysis.common.outcome_table import OutcomeTable, State
from ds_analysis.common.statistics import Array, Bools, Indices
from ds_analysis.prediction.car import Bet, CarPrediction, certify, drives_in_order, drives_until
from ds_analysis.prediction.experts import RateExpert
from ds_analysis.prediction.mixture import Prediction
from ds_analysis.real.proposal import BudgetError, Proposed, ProposedDrive, propose, read_proposed
from ds_analysis.real.records import RealDrive, RecordError, added, read_csv
from ds_report.drives_on_the_car import draw_sheet, sheet_of, write_drives_to_do
from ds_sim.conditions.text import parse_conditions


def simulated(seed: int, tests: int, rate: float) -> tuple[OutcomeTable, dict[str, bool]]:
    """Tests that some fail, and the siblings hardly know which; names differ between seeds, and so do draws."""
    rng = np.random.default_rng([seed, int(100 * rate)])
    margins = np.where(rng.random((tests, 1)) < rate, 0.5, -0.5) + 0.4 * rng.normal(size=(tests, 3))
    margins[:, 2] = np.where(rng.random(tests) < rate, 0.5, -0.5)
    table = table_of_margins(margins, rng.normal(size=(tests, 2)), family=1, names=f"s{seed}")
    return table.with_twin(None).select(np.arange(tests)), dict(zip(table.test_ids, margins[:, -1] > 0, strict=True))


def car_of(table: OutcomeTable, drives: list[RealDrive], proposed: Proposed) -> CarPrediction:
    """The car as `predict_car` reads it, predicted by the drives' failure rate alone, which is fast."""
    undriven = Prediction(tests=len(table), experts=(RateExpert(),), prior=np.ones(1))
    ordered = drives_in_order(table, drives, proposed)
    return CarPrediction(
        table=table, undriven=undriven, prediction=undriven.updated(ordered), drives=drives, proposed=proposed
    )


@pytest.mark.parametrize("rate", [0.03, 0.2, 0.6])
def test_the_certificate_holds_whoever_proposes_records_and_stops(tmp_path: Path, rate: float) -> None:
    """Repeated proposals, changed budgets, drives left out or chosen to mislead, and a look after each of them.

    The driver knows which tests fail: he drives failing ones by choice until none is left, and leaves out a drawn test
    that fails now and then. The true number may be outside at any look of one run in twenty.
    """
    wrong, runs, tests = 0, 120, 40
    for seed in range(runs):
        table, truth = simulated(seed, tests, rate)
        rng, folder = np.random.default_rng([9, seed]), tmp_path / str(seed)
        failing, drives, outside = sum(truth.values()), dict[str, RealDrive](), False
        while len(drives) < tests - 6:
            for _ in range(int(rng.integers(1, 4))):  # proposes again before anything is recorded
                budget, driven = int(rng.integers(1, 5)), set(drives)
                left = tests - len({*driven, *read_proposed(folder).tests})
                if left:
                    prediction = car_of(table, list(drives.values()), read_proposed(folder)).prediction
                    propose(folder, table, prediction, driven, min(budget, left), spread=bool(rng.random() < 0.2))
            proposed = read_proposed(folder)
            for test_id in proposed.tests:
                if test_id not in drives and rng.random() < (0.9 if truth[test_id] else 1.0):
                    drives[test_id] = real_drive(test_id, truth[test_id])
            if rng.random() < 0.5:
                chosen = [one for one in truth if truth[one] and one not in drives] or [*({*truth} - {*drives})]
                drives.update({one: real_drive(one, truth[one]) for one in sorted(chosen)[:2]})
            found = car_of(table, list(drives.values()), proposed).certificate
            outside |= found is not None and not found.low <= failing <= found.high
        wrong += outside
    assert wrong / runs <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / runs)


def test_proposals_continue_one_random_order_and_a_drive_counts_once(tmp_path: Path) -> None:
    """Three proposals before anything is recorded are thirty tests; recorded, each of the first ten counts once."""
    table, _ = simulated(1, 132, 0.1)
    undriven = car_of(table, [], Proposed()).undriven
    rounds = [[one.test_id for one in propose(tmp_path, table, undriven, (), 10)] for _ in range(3)]
    assert len({test for one in rounds for test in one}) == 30
    drives = [real_drive(test_id, False) for test_id in rounds[0]]
    car = car_of(table, drives, read_proposed(tmp_path))
    assert car.certificate == certify([Bet(failed=False, drawn=True)] * 10, 132)
    assert list(car.open) == [*rounds[1], *rounds[2]]
    # A file that proposed the same tests thrice, as 0.2 did: still ten drives.
    rows = [[{"test_id": one, "gain": None} for one in rounds[0]]] * 3
    (tmp_path / "real/proposal.json").write_text(json.dumps({"scale": 16.0, "rounds": rows}))
    car = car_of(table, drives, read_proposed(tmp_path))
    assert car.certificate is not None and car.certificate.drawn == 10 and car.open == []
    with pytest.raises(BudgetError, match="123 drives: 122 tests can be proposed"):
        propose(tmp_path, table, undriven, (), 123)


def test_drives_after_one_that_was_left_out_are_not_drawn(tmp_path: Path) -> None:
    table, _ = simulated(2, 40, 0.2)
    order = [one.test_id for one in propose(tmp_path, table, car_of(table, [], Proposed()).undriven, (), 8)]
    drives = [real_drive(test_id, False) for test_id in order if test_id != order[3]]
    ordered = drives_in_order(table, drives, read_proposed(tmp_path))
    assert [one.drawn for one in ordered] == [True] * 3 + [False] * 4
    chosen = next(one for one in table.test_ids if one not in order)
    ordered = drives_in_order(table, [real_drive(chosen, True, drawn=True), *drives], read_proposed(tmp_path))
    assert [one.drawn for one in ordered] == [True] * 3 + [False] * 5


def test_drives_that_were_not_proposed_count_and_certify_only_if_drawn(tmp_path: Path) -> None:
    table, truth = simulated(3, 40, 0.2)
    drives = [real_drive(test_id, truth[test_id]) for test_id in table.test_ids[:5]]
    assert car_of(table, drives, Proposed()).certificate is None
    said = car_of(table, [replace(one, drawn=True) for one in drives], Proposed()).certificate
    assert said is not None and said.drawn == 5 and said.tests == 40
    driven = {one.test_id for one in drives}
    found = [one.test_id for one in propose(tmp_path, table, car_of(table, drives, Proposed()).prediction, driven, 35)]
    assert not driven.intersection(found)
    everything = [*drives, *(real_drive(one, truth[one]) for one in found)]
    last = car_of(table, everything, read_proposed(tmp_path)).certificate
    assert last is not None and last.low == last.high == sum(truth.values()) and last.drawn == 35


def test_an_excluded_test_is_not_proposed(tmp_path: Path) -> None:
    table, _ = simulated(4, 20, 0.3)
    states = table.states.copy()
    states[5, 1], states[6, :] = State.EXCLUDED, State.MISSING
    limited = replace(table, states=states)
    found = propose(tmp_path, limited, car_of(table, [], Proposed()).undriven, (), 18)
    assert {one.test_id for one in found} == {*table.test_ids} - {table.test_ids[5], table.test_ids[6]}


def test_a_road_is_taped_out_at_the_car_s_size() -> None:
    sheet = sheet_of(ROAD, 16.0)
    assert sheet.lane_width == 0.25 and sheet.stations[-1] == pytest.approx(ROAD.length / 16, rel=1e-3)
    rows = list(csv.DictReader(sheet.csv().splitlines()))
    for row in rows[:: len(rows) // 7]:
        left, right, lane, centre = (
            np.array([float(row[f"{name}_{axis}_m"]) for axis in "xy"])
            for name in ("left_edge", "right_edge", "lane_centre", "centre_line")
        )
        assert np.hypot(*(left - right)) == pytest.approx(0.5, abs=0.03)
        assert np.hypot(*(lane - centre)) == pytest.approx(0.125, abs=0.01)
        assert (np.array([left, right]) > 0).all() and (np.array([left, right]) < (sheet.width, sheet.height)).all()
    image = draw_sheet(sheet, "a road")
    assert image.shape[0] > 400 and (image < 60).all(axis=2).mean() > 0.003  # black edges


CSV = "test_id,outcome,who,when,max_lateral_position,note\n"
HALF_LANES = {"a": 2.0, "b": 2.0}


def test_conditions_are_set_in_the_car_s_own_lengths_and_speeds(tmp_path: Path) -> None:
    """Fog of 48 m on the road hides a model's lane like 3 m do; angles, shares, light and time do not scale."""
    conditions = parse_conditions(
        "line_contrast=0.4617371566636695,visibility=48,camera_pitch=3deg,illuminance=1000,speed_limit=4,steering_lag=0.2"
    )
    drive = ProposedDrive(
        test_id="a",
        road=ROAD,
        conditions=conditions,
        features={},
        scale=16.0,
        probability=0.5,
        drawn=True,
        siblings={"bullet": "failed"},
    )
    assert drive.to_set == {
        "line_contrast": "0.462",
        "visibility": "3 m (48 m at full scale)",
        "camera_pitch": "3 degrees",
        "illuminance": "1000 lx",
        "speed_limit": "0.25 m/s (4 m/s at full scale)",
        "steering_lag": "0.2 s",
    }
    assert replace(drive, scale=1.0).to_set["visibility"] == "48 m"
    text = (write_drives_to_do(tmp_path, 1, [drive]) / "README.md").read_text()
    assert all(f"- set {name} to {value}: " in text for name, value in drive.to_set.items())
    assert parse_conditions(drive.document()["conditions"]) == conditions


def test_outcomes_are_read_in_metres_of_the_road(tmp_path: Path) -> None:
    file = tmp_path / "drives.csv"
    file.write_text(CSV + "a,completed,Ada,2026-03-01,0.05,dry\nb,stuck,Ada,2026-03-01T10:00,,\n")
    one, two = read_csv(file, HALF_LANES, scale=16.0)
    assert one.max_lateral_position == pytest.approx(0.8) and not one.failed and one.note == "dry"
    assert two.failed and two.outcome == "stuck" and two.max_lateral_position is None
    file.write_text("test_id,outcome\na,completed\n")
    (one,) = read_csv(file, HALF_LANES, scale=16.0, who="Ada", when="2026-03-01")
    assert one.who == "Ada" and added([one], [one]) == [one]
    file.write_text(CSV + "a,completed,Ada,2026-03-01,,\na,failed,Bob,2026-03-02,,\n")
    with pytest.raises(RecordError, match="test a has two outcomes: completed .Ada, 2026-03-01, drives.csv., and fail"):
        added([], read_csv(file, HALF_LANES, scale=16.0))


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ("c,completed,Ada,2026-03-01,,", "line 2: there is no test 'c': expected one of a, b"),
        ("a,crashed,Ada,2026-03-01,,", "outcome 'crashed': expected one of completed, failed"),
        ("a,completed,,2026-03-01,,", "who is empty: fill it in, or give --who"),
        ("a,completed,Ada,yesterday,,", "when is 'yesterday', expected a date such as 2026-03-01"),
        ("a,completed,Ada,2026-03-01,nan,", "expected metres on the car's road"),
        ("a,completed,Ada,2026-03-01,-1,", "expected metres on the car's road"),
        ("a,completed,Ada,2026-03-01,0.2,", "completed with a lateral position of 0.2 m: the lane's edge is at 0.125"),
        ("a,out_of_bounds,Ada,2026-03-01,0.1,", "out of bounds with a lateral position of 0.1 m"),
        ("", "no rows"),
    ],
)
def test_outcomes_that_cannot_be_are_refused_in_one_line(tmp_path: Path, row: str, named: str) -> None:
    file = tmp_path / "drives.csv"
    file.write_text(CSV + row + ("\n" if row else ""))
    with pytest.raises(RecordError) as caught:
        read_csv(file, HALF_LANES, scale=16.0)
    assert named in str(caught.value) and "\n" not in str(caught.value)


def bets_of(truth: Bools, predicted: Array, order: Indices, drawn: Bools) -> list[Bet]:
    left = np.ones(len(truth), bool)
    found = []
    for row, by_chance in zip(order, drawn, strict=True):
        guess, mean = float(predicted[row]), float(predicted[left].mean())
        found.append(Bet(failed=bool(truth[row]), drawn=bool(by_chance), predicted=guess, mean_predicted=mean))
        left[row] = False
    return found


def mixed_order(truth: Bools, predicted: Array, rng: np.random.Generator) -> tuple[Indices, Bools]:
    """Every other test is chosen: here adversarially, the likeliest to fail; the others are drawn."""
    left, order = set(range(len(truth))), []
    for place in range(len(truth)):
        rows = np.array(sorted(left))
        row = int(rng.choice(rows)) if place % 2 else int(rows[np.argmax(predicted[rows] + truth[rows])])
        order.append(row)
        left.remove(row)
    return np.array(order, np.intp), np.arange(len(truth)) % 2 == 1


@pytest.mark.parametrize("rate", [0.0, 0.05, 0.3, 0.5, 0.9])
@pytest.mark.parametrize("chosen", [False, True])
def test_the_truth_is_hardly_ever_excluded_at_any_time(rate: float, chosen: bool) -> None:
    """Stopped at the worst moment of all: whenever the truth is outside for the first time, or never."""
    wrong, runs, tests = 0, 150, 60
    for seed in range(runs):
        rng = np.random.default_rng([seed, int(100 * rate)])
        truth = rng.random(tests) < rate
        predicted = np.clip(truth + rng.normal(0.0, 0.4, tests), 0.01, 0.99)  # any predictions are allowed
        order, drawn = mixed_order(truth, predicted, rng) if chosen else (rng.permutation(tests), np.ones(tests, bool))
        bets = bets_of(truth, predicted, order, drawn)
        ends = [certify(bets[:k], tests) for k in range(1, tests + 1, 3)]
        wrong += any(not one.low <= truth.sum() <= one.high for one in ends)
    assert wrong / runs <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / runs)


def test_good_predictions_narrow_the_bounds_and_bad_ones_cost_little() -> None:
    widths: dict[str, list[int]] = {"good": [], "none": [], "bad": []}
    for seed in range(30):
        rng = np.random.default_rng(seed)
        truth = rng.random(200) < 0.4
        order = rng.permutation(200)[:60]
        good, none, bad = np.where(truth, 0.97, 0.03), np.full(200, 0.4), rng.permutation(truth) * 1.0
        for name, predicted in (("good", good), ("none", none), ("bad", bad)):
            found = certify(bets_of(truth, predicted, order, np.ones(60, bool)), 200)
            widths[name].append(found.high - found.low)
    assert np.mean(widths["good"]) < np.mean(widths["none"]) and np.mean(widths["bad"]) < 1.25 * np.mean(widths["none"])


def test_drives_needed_are_those_after_which_the_bound_is_reached() -> None:
    needed = drives_until(0.1, 200)
    assert needed is not None and 24 < needed < 60  # Jeffreys, with a size fixed beforehand: 24
    passes = [Bet(failed=False, drawn=True)]
    assert certify(passes * needed, 200).high <= 20 < certify(passes * (needed - 1), 200).high
    assert drives_until(0.0, 20) == 20
