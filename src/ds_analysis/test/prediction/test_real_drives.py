"""A few drives on a real car: which are chosen, what they change, and what is refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prediction_tables import alike, made_up
from test_prediction_verbs import ROADS, write_comparison

from ds_analysis.prediction.real.drive_choice import BudgetError, choose
from ds_analysis.prediction.real.proposal import ProposedDrive, read_proposed, write_proposal
from ds_analysis.prediction.real.records import RecordError, added, read_csv, read_drives
from ds_analysis.prediction.real.road_sheet import draw_sheet, sheet_of
from ds_analysis.prediction.twin_prediction import DOUBT, MarginDrive, TwinPrediction, predict_twin, span_of
from ds_cli.application import run
from ds_sim.conditions.text import parse_conditions


def drive_of(truth: np.ndarray, row: int) -> MarginDrive:  # type: ignore[type-arg]
    value = float(truth[row])
    return MarginDrive(row=row, failed=value > 0, margin=value if value <= 0 else None)


def in_order(prediction: TwinPrediction, table, truth, drives: int) -> list[TwinPrediction]:  # type: ignore[no-untyped-def]
    """Choose, drive and update, one drive after the other."""
    steps = [prediction]
    for _ in range(drives):
        (choice,) = choose(table, steps[-1], 1)
        steps.append(steps[-1].updated([drive_of(truth, choice.row)]))
    return steps


def test_the_first_choice_is_that_of_brute_force() -> None:
    """Variance of every test's probability that the verdict explains, by weighting draws with both verdicts."""
    table, _ = made_up(31, tests=60)
    prediction = alike(predict_twin(table, in_turn=False))
    draws = prediction.draws(500)
    sizes = {cell: table.cells.count(cell) for cell in table.cells}
    weights = np.array([1 / sizes[cell] for cell in table.cells])
    gains = []
    for c in range(60):
        fails = draws[:, c]
        mean = draws.mean(axis=0)
        gain = 0.0
        for share, likelihood in ((fails.mean(), fails), (1 - fails.mean(), 1 - fails)):
            after = likelihood @ draws / likelihood.sum()
            gain += share * float(weights @ (after - mean) ** 2)
        gains.append(gain / weights.sum())
    (choice,) = choose(table, prediction, 1)
    assert choice.gain is not None
    assert choice.row == int(np.argmax(gains)) and choice.gain == pytest.approx(max(gains), rel=1e-6)


def test_choices_are_spread_over_families_and_tell_less_and_less() -> None:
    table, _ = made_up(32, tests=60, family=10)
    found = choose(table, predict_twin(table), 6)
    assert len({int(table.families[one.row]) for one in found[::2]}) == 3
    assert len({one.row for one in choose(table, predict_twin(table), 12)}) == 12  # more than families
    assert [one.gain is None for one in found] == [False, True] * 3  # every other one is drawn
    gains = [one.gain for one in found if one.gain is not None]
    assert gains[0] > gains[-1] > 0
    assert [one.row for one in choose(table, predict_twin(table), 6)] == [one.row for one in found]
    with pytest.raises(BudgetError, match="61 drives: 60 tests can be proposed"):
        choose(table, predict_twin(table), 61)


def test_a_driven_or_excluded_test_is_not_proposed() -> None:
    table, truth = made_up(33, tests=20)
    prediction = predict_twin(table).updated([drive_of(truth.margins[:, 3], k) for k in range(5)])
    states = table.states.copy()
    states[5, 1] = 3  # excluded on one sibling
    from dataclasses import replace

    rows = {one.row for one in choose(replace(table, states=states), prediction, 14)}
    assert rows == set(range(6, 20))


def test_chosen_drives_tell_more_than_random_ones() -> None:
    chosen: list[float] = []
    random: list[float] = []
    for seed in range(12):
        table, truth = made_up(400 + seed, tests=120, tau=(0.67, 0.17))  # the medians of their priors
        twin = truth.margins[:, 3]
        prediction = predict_twin(table, in_turn=False)
        failed = twin > 0
        for found, rows in (
            (chosen, [one.row for one in choose(table, prediction, 4)]),
            (random, np.random.default_rng(seed).permutation(120)[:4]),
        ):
            after = prediction.updated([MarginDrive(row=int(k), failed=bool(failed[k])) for k in rows])
            found.append(float(np.mean((after.probabilities() - failed) ** 2)))
    assert np.mean(chosen) < np.mean(random)


@pytest.mark.long
def test_a_car_outside_is_noticed_within_four_drives_and_one_inside_is_not() -> None:
    noticed, alarms = 0, 0
    for seed in range(20):
        table, truth = made_up(500 + seed, tests=100, twin=np.array([0.7, 0.3, 0.2, -0.2, 0.1]))
        # All siblings lie at least 0.7 further in; a blend of siblings is no outsider.
        beyond = 0.7 - truth.coefficients[:3, 0].max()
        if beyond > 0.7:
            spans = [
                span_of(step) for step in in_order(predict_twin(table, in_turn=False), table, truth.margins[:, 3], 4)
            ]
            noticed += any(span.outside for span in spans)
            assert all(span.shift > 0 for span in spans if span.outside)
        else:
            noticed += 1
        inside = truth.margins[:, :2].mean(axis=1)
        spans = [span_of(step) for step in in_order(predict_twin(table, in_turn=False), table, inside, 4)]
        alarms += any(span.outside for span in spans)
        assert all(bool(span.warning) == (span.outside or span.alike < DOUBT) for span in spans if span.drives)
    assert noticed >= 18 and alarms <= 1


def test_a_road_is_taped_out_at_the_car_s_size(tmp_path: Path) -> None:
    sheet = sheet_of(ROADS[0], 16.0)
    assert sheet.lane_width == 0.25 and sheet.stations[-1] == pytest.approx(ROADS[0].length / 16, rel=1e-3)
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
        test_id="a", road=ROADS[0], conditions=conditions, features={}, limit=2.0, scale=16.0, probability=0.5,
        gain=0.01, siblings={"bullet": "failed"}, if_fails=0.9, if_completes=0.1, decided=(0, 1, 2),
    )  # fmt: skip
    assert drive.to_set == {
        "line_contrast": "0.462", "visibility": "3 m (48 m at full scale)", "camera_pitch": "3 degrees",
        "illuminance": "1000 lx", "speed_limit": "0.25 m/s (4 m/s at full scale)", "steering_lag": "0.2 s",
    }  # fmt: skip
    assert replace(drive, scale=1.0).to_set["visibility"] == "48 m"
    (tmp_path / "real").mkdir()
    place, _ = write_proposal(tmp_path, [drive])
    text = (place / "README.md").read_text()
    assert all(f"- set {name} to {value}: " in text for name, value in drive.to_set.items())
    kept = json.loads((tmp_path / "real/proposal.json").read_text())["rounds"][0][0]
    assert parse_conditions(kept["conditions"]) == conditions


def test_outcomes_are_read_in_metres_of_the_road(tmp_path: Path) -> None:
    file = tmp_path / "drives.csv"
    file.write_text(CSV + "a,completed,Ada,2026-03-01,0.05,dry\nb,stuck,Ada,2026-03-01T10:00,,\n")
    one, two = read_csv(file, HALF_LANES, scale=16.0)
    assert one.max_lateral_position == pytest.approx(0.8) and not one.failed and one.note == "dry"
    assert two.failed and two.outcome == "stuck" and two.max_lateral_position is None
    file.write_text("test_id,outcome\na,completed\n")
    (one,) = read_csv(file, HALF_LANES, scale=16.0, who="Ada", when="2026-03-01")
    assert one.who == "Ada" and added([one], [one]) == [one]


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ("c,completed,Ada,2026-03-01,,", "line 2: test 'c' was never proposed: expected one of a, b"),
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


def test_two_outcomes_of_one_test_contradict_each_other(tmp_path: Path) -> None:
    file = tmp_path / "drives.csv"
    file.write_text(CSV + "a,completed,Ada,2026-03-01,,\na,failed,Bob,2026-03-02,,\n")
    with pytest.raises(
        RecordError, match="test a has two outcomes: completed .Ada, 2026-03-01, drives.csv., and failed"
    ):
        added([], read_csv(file, HALF_LANES, scale=16.0))


def test_drives_are_proposed_recorded_and_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_comparison(tmp_path / "compared")
    before = (folder / "comparison.json").read_bytes()
    assert run(["real", "propose", str(folder), "--drives", "3", "--json"]) == 0
    proposed = json.loads(capsys.readouterr().out)["drives"]
    place = folder / "real/round_1"
    assert len(list(place.glob("*.png"))) == 3 and len(list(place.glob("[123]_*.csv"))) == 3
    text = (place / "README.md").read_text()
    assert all(one["test_id"] in text and one["decides"] in text for one in proposed)
    # The siblings fail half of the time; the car never does.
    rows = list(csv.reader((place / "outcomes.csv").read_text().splitlines()))
    filled = place / "filled.csv"
    filled.write_text(
        "\n".join(
            ",".join(row)
            for row in [rows[0], *([r[0], "completed", "Ada", "2026-03-01", "0.01", ""] for r in rows[1:])]
        )
    )
    assert run(["real", "record", str(folder), str(filled), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["failures"][1] < document["failures"][0] - 0.05
    # One of the three drives was drawn, so that much is certain.
    assert document["certificate"]["drawn"] == 1 and document["certificate"]["high"] < document["certificate"]["tests"]
    assert document["span"]["outside"] and "closer to its lane's centre than any" in document["span"]["warning"]
    driven = {one["test_id"] for one in document["after"]["tests"] if one["driven"]}
    assert driven == {one["test_id"] for one in proposed}
    assert [drive.who for drive in read_drives(folder)] == ["Ada"] * 3
    # A drive decides its test, but alone no cell.
    cells = [one for one in document["after"]["cells"] if one["driven"] == one["tests"] == 1]
    assert all(0.0 < one["rate"] < one["interval"][1] for one in cells)
    assert {"before.png", "after.png", "update.json"} <= {path.name for path in (folder / "real").iterdir()}
    # Again, which changes nothing; then further drives, which are others.
    assert run(["real", "record", str(folder), str(filled)]) == 0
    shown = capsys.readouterr().out
    assert "3 real drives, 0 failed" in shown and "the car is outside" in shown
    assert run(["real", "propose", str(folder), "--drives", "3", "--json"]) == 0
    more = {one["test_id"] for one in json.loads(capsys.readouterr().out)["drives"]}
    assert not more & driven and len(read_proposed(folder).limits) == 6
    assert (folder / "comparison.json").read_bytes() == before


def test_bad_requests_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_comparison(tmp_path / "compared")
    file = tmp_path / "drives.csv"
    file.write_text(CSV + "a,completed,Ada,2026-03-01,,\n")
    damaged = write_comparison(tmp_path / "damaged")
    (damaged / "real").mkdir()
    (damaged / "real/drives.json").write_text("[{}]")
    for named, arguments in (
        ("nothing was proposed", ["real", "record", str(folder), str(file)]),
        (
            "40 tests can be proposed, expected a budget of at most 40",
            ["real", "propose", str(folder), "--drives", "41"],
        ),
        ("--drives", ["real", "propose", str(folder), "--drives", "0"]),
        ("has no real drives", ["real", "update", str(folder)]),
        ("drives.json cannot be read", ["real", "update", str(damaged)]),
    ):
        assert run(arguments) == 2
        captured = capsys.readouterr()
        lines = [line for line in captured.err.splitlines() if line.startswith("error")]
        assert captured.out == "" and len(lines) == 1 and named in lines[0], captured.err
    assert run(["real", "propose", str(folder), "--drives", "1"]) == 0
    capsys.readouterr()
    assert run(["real", "record", str(folder), str(tmp_path)]) == 2
    assert "which proposed test is it? expected --test with one of" in capsys.readouterr().err
    assert run(["real", "record", str(folder), str(file)]) == 2
    assert "test 'a' was never proposed" in capsys.readouterr().err
    assert run(["real", "propose", str(folder), "--drives", "1", "--scale", "10"]) == 2
    assert "drives of a car of 1:16 were proposed before" in capsys.readouterr().err
