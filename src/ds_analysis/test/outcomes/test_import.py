# SPDX-License-Identifier: Apache-2.0
"""Outcomes from elsewhere: tables with gaps and words, files of a competition, one line for what is wrong; exports."""

from __future__ import annotations

import json
import sqlite3
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml
from report_campaigns import campaign_data

from ds_analysis.common.outcome_table import OutcomeTableError, RoadTable, State
from ds_analysis.comparison.analysis import answer_of
from ds_analysis.comparison.tables import document_of, drive_table, markdown_of
from ds_analysis.outcomes.columns import Columns, ImportNotes, read_columns
from ds_analysis.outcomes.frames import COLUMNS, write_frames
from ds_analysis.outcomes.reading import read_table
from ds_analysis.outcomes.sbft import read_competition
from ds_analysis.outcomes.study import Study, import_outcomes, read_frame, read_study, study_of, write_rows, write_study
from ds_analysis.outcomes.study_results import compare_studies, maps_of_study
from ds_analysis.prediction.car import predict_car
from ds_analysis.prediction.mixture import predict
from ds_analysis.real.proposal import propose
from ds_analysis.real.records import read_drives
from ds_base.left_out import LeftOut
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import MapId
from ds_report.study_page import write_study_page
from ds_road import generate
from ds_sim import SimulatorName
from ds_sim.conditions.model import DEFAULT, Conditions

CAR = SimulatorName("car")

RNG = np.random.default_rng(9)
SPEED, CURVE = RNG.uniform(5, 20, 40), RNG.uniform(0, 0.2, 40)


def long_table() -> pd.DataFrame:
    """Forty tests, three simulators, two repeats: the lateral position follows speed and curve."""
    rows = []
    for test in range(40):
        for factor, simulator in ((1.0, "lofi"), (1.1, "hifi"), (0.9, "car")):
            for rep in (1, 2):
                lateral = factor * 0.05 * SPEED[test] * (1 + 8 * CURVE[test]) * (1 + 0.01 * rep)
                rows.append((test, simulator, rep, round(lateral, 4), SPEED[test], CURVE[test]))
    return pd.DataFrame(rows, columns=["route", "sim", "rep", "xte", "speed", "curve"])


LONG: dict[str, Any] = {
    "test": "route",
    "simulator": "sim",
    "repeat": "rep",
    "margin": {"column": "xte", "limit": 1.2},
    "twin": "car",
}


def imported(folder: Path, frame: pd.DataFrame, **changed: Any) -> Study:
    """Import a table by a file of columns, those of the long table but for what is changed; None leaves one out."""
    columns = {name: value for name, value in {**LONG, **changed}.items() if value is not None}
    (folder / "c.yaml").write_text(yaml.safe_dump(columns))
    return read(folder, frame, read_columns(folder / "c.yaml"))[0]


def read(
    folder: Path, frame: pd.DataFrame, columns: Columns, *more: Path, strict: bool = False
) -> tuple[Study, ImportNotes]:
    frame.to_csv(folder / "t.csv", index=False)
    notes = ImportNotes(rows=LeftOut("rows", strict))
    return import_outcomes([folder / "t.csv", *more], columns, notes), notes


def test_a_long_table_becomes_the_outcomes_that_it_states(tmp_path: Path) -> None:
    frame = long_table()
    study = imported(tmp_path, frame)
    assert study.features == ("speed", "curve") and study.simulators == ["lofi", "hifi", "car"]
    write_study(tmp_path, study)
    table = read_table(tmp_path)
    assert (table.siblings, table.twin, len(table)) == (("lofi", "hifi"), "car", 40)
    assert len(set(table.families)) == 40 and table.feature_names == ("speed", "curve")
    for row, test_id in enumerate(table.test_ids):
        route = int(test_id)
        for column, name in enumerate(table.simulators):
            xte = float(np.mean(frame[(frame.route == route) & (frame.sim == name)].xte))  # of two, the median
            assert table.states[row, column] in (State.FAILED if xte > 1.2 else State.COMPLETED, State.FAILED)
            assert table.lateral[row, column] == pytest.approx(xte) and table.limits[row, column] == 1.2
        width = study.axes["speed"]
        assert table.cells[row] is not None and table.cells[row][0] == SPEED[route] // width  # type: ignore[index]
    prediction = predict(table).probabilities()
    truth = table.failed(CAR)
    assert ((prediction - truth) ** 2).mean() < ((truth.mean() - truth) ** 2).mean() / 2


def test_a_wide_table_with_rules_and_features_in_a_second_file(tmp_path: Path) -> None:
    wide = pd.DataFrame({"a": [1, 1, 2], "b": [0, 1, 0], "lo": ["ok", "crash", "ok"], "hi": [0, 3, 1]})
    pd.DataFrame({"a": [1, 1, 2], "b": [0, 1, 0], "length": [3.0, 4.0, 5.0]}).to_csv(tmp_path / "f.csv", index=False)
    columns = {
        "test": ["a", "b"],
        "simulators": {
            "lo": {"failed": {"column": "lo", "is_not": "ok"}},
            "hi": {"failed": [{"column": "hi", "above": 0}]},
        },
        "features": ["length", "a"],
    }
    study, _ = read(tmp_path, wide, Columns.model_validate(columns), tmp_path / "f.csv")
    assert study.rows.pivot(index="test_id", columns="simulator", values="failed").to_dict() == {
        "lo": {"1-0": False, "1-1": True, "2-0": False},
        "hi": {"1-0": False, "1-1": True, "2-0": True},
    }
    assert study.rows["length"].tolist() == [3.0, 4.0, 5.0] * 2 and np.isnan(study.rows["margin"]).all()


def test_a_verdict_alone_bounds_the_margin_at_the_limit(tmp_path: Path) -> None:
    frame = long_table()
    frame["failed"] = frame.xte > 1.2
    study = imported(tmp_path, frame.drop(columns="xte"), margin=None, failed="failed")
    table, known = study.table(), imported(tmp_path, frame).table()
    assert np.isnan(table.lateral[:, :2]).all() and np.array_equal(table.states, known.states)
    # Margins say more: a prediction from them differs, and both are finite.
    one, two = (predict(each).probabilities() for each in (table, known))
    assert np.isfinite(one).all() and np.isfinite(two).all() and not np.allclose(one, two)


def test_a_car_s_rows_are_its_drives(tmp_path: Path) -> None:
    """20 of 40 tests were driven on the car: never a sibling, never proposed again, counted unasked."""
    frame = long_table()
    frame = frame[(frame.sim != "car") | (frame.route < 20)]
    study = imported(tmp_path, frame, twin=None, car="car")
    write_study(tmp_path, study)
    table, drives = read_table(tmp_path), read_drives(tmp_path)
    assert table.simulators == ("lofi", "hifi") and len(table) == 40 and len(drives) == 20
    truth = frame[frame.sim == "car"].groupby("route").xte.median() > 1.2
    assert {int(one.test_id): one.failed for one in drives} == truth.to_dict() and not any(one.drawn for one in drives)
    car = predict_car(tmp_path, table)
    assert car.sentence.startswith("Of the 20 tests that the car has not driven, ") and car.certificate is None
    assert f"The car drove 20 tests and failed {truth.sum()}" in car.sentence and "without a real" not in car.sentence
    driven = {one.test_id for one in drives}
    found = propose(tmp_path, table, car.prediction, driven, 20)
    assert not driven & {one.test_id for one in found}
    page = write_study_page(tmp_path, read_study(tmp_path)).read_text()
    assert "car (car)" in page and "lofi and hifi" in page and "car fails on" not in page
    # Said to be drawn at random, they certify; a wide table leaves the car's other rows empty.
    wide = frame.pivot_table(index=["route", "speed", "curve"], columns="sim", values="xte").reset_index()
    columns = {
        "test": "route",
        "features": ["speed", "curve"],
        "car": "car",
        "car_drawn": True,
        "simulators": {name: {"margin": {"column": name, "limit": 1.2}} for name in ("lofi", "hifi", "car")},
    }
    write_study(tmp_path / "wide", read(tmp_path, wide, Columns.model_validate(columns))[0])
    certificate = predict_car(tmp_path / "wide", read_table(tmp_path / "wide")).certificate
    assert certificate is not None and (certificate.drawn, certificate.tests) == (20, 40)
    assert certificate.low <= int(truth.sum()) + 10 and certificate.high < 40


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_export_and_import_are_inverse(tmp_path: Path, suffix: str) -> None:
    study = imported(tmp_path, long_table())
    write_rows(tmp_path / f"out{suffix}", study)
    again = import_outcomes([tmp_path / f"out{suffix}"], Columns(twin=CAR))
    pd.testing.assert_frame_equal(again.rows, study.rows)
    assert (again.features, again.twin, again.simulators) == (study.features, study.twin, study.simulators)
    one, other = study.table(), again.table()
    assert np.array_equal(one.states, other.states) and np.array_equal(one.features, other.features)
    assert one.test_ids == other.test_ids


def test_repeats_that_disagree_are_counted(tmp_path: Path) -> None:
    frame = long_table()
    frame["failed"] = np.where((frame.sim == "car") & (frame.route < 10), frame.rep == 2, False)
    study = imported(tmp_path, frame.drop(columns="xte"), margin=None, failed="failed")
    assert study.flakiness()["car"] == (40, 80, 0.125, 0.25) and study.flakiness()["lofi"][3] == 0.0


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"test": "id"}, r"has no column 'id', but route, sim, rep, xte.*: say in --columns which is what"),
        ({"margin": {"column": "xte", "limit": {"lofi": 1.0}}}, "margin.limit names no limit for hifi"),
        ({"margin": None, "failed": "sim"}, r"line 2 \(route=0, sim=lofi, .*: sim is 'lofi', expected true or false"),
        ({"repeat": None}, "test 0 comes twice on lofi: name the column of the repetition"),
        ({"features": ["sim"]}, "sim differs between drives of 40 tests, as 0: it is no feature"),
        ({"twin": "bus"}, "has no simulator 'bus': expected car, hifi, lofi"),
        ({"car": "bus"}, "has no simulator 'bus': expected car, hifi, lofi"),
        ({"car": "car"}, "the car is 'car': expected a simulator beside it, and no twin"),
        ({"map": {"speed": 1.0, "age": 1.0}}, "axis 'age' is no feature: expected speed, curve"),
        ({"map": {"speed": 1e-6, "curve": 0.1}}, "bins of 1e-06 cut speed into more than 200: widen them"),
        ({"features": ["speed"]}, "has one feature, speed: expected two or more"),
        ({"where": [{"column": "rep", "above": 9}]}, "has no rows where they have to be"),
        ({"margin": {"column": "xte", "limit": "1.1 m"}}, "margin.limit is '1.1 m', expected a number"),
        ({"margin": None, "failed": {"column": "sim", "is": "LOFY"}}, "sim is never 'LOFY', but car, hifi, lofi"),
        ({"where": [{"column": "rep"}]}, "where.0: expected one of is, is_not, above and below"),
        ({"tests": "route"}, r"tests: Extra inputs are not permitted \(keys: test, simulator, simulators"),
        ({"margin": None}, "name the column that says whether a test failed"),
    ],
)
def test_what_is_wrong_gets_one_line(tmp_path: Path, changed: dict[str, Any], said: str) -> None:
    with pytest.raises(OutcomeTableError, match=said) as raised:
        imported(tmp_path, long_table(), **changed)
    assert "\n" not in str(raised.value)


def test_a_number_that_differs_between_drives_of_a_test_is_no_feature(tmp_path: Path) -> None:
    frame = long_table()
    frame["wind"] = frame.rep + 0.1 * frame.route
    study, notes = read(tmp_path, frame, Columns.model_validate(LONG))
    assert study.features == ("speed", "curve")
    assert notes.columns.line().startswith("1 of 3 columns left out: wind (differs between drives of 40")
    with pytest.raises(OutcomeTableError, match="differs between drives of 40 tests, as 0: it is no feature"):
        read(tmp_path, frame, Columns.model_validate({**LONG, "features": ["curve", "wind"]}))


WEATHERS = ["rain", "clear", "fog", None]
SPEEDS = np.random.default_rng(4).uniform(5.0, 20.0, 24).round(2)


def leaderboard() -> pd.DataFrame:
    """24 routes on two simulators, with words, identifiers, remarks, and a speed that route 3 does not have."""
    rows = [
        {
            "test_id": f"RouteScenario_{route}",
            "simulator": simulator,
            "failed": "Failed" if route % 3 == 0 else "Completed",
            "town": f"Town0{route % 2 + 1}",
            "weather": WEATHERS[route % 4],
            "speed": None if route == 3 else SPEEDS[route],
            "turns": route % 5,
            "save_name": f"run_{route}",
            "remark": f"note {route % 13}",
            "status": "as planned" if route % 2 else "late",
            "route_index": route,
            "score_composed": 100.0 - route,
        }
        for route in range(24)
        for simulator in ("carla", "lgsvl")
    ]
    return pd.DataFrame(rows)


def test_words_become_levels_and_gaps_the_median_with_an_indicator(tmp_path: Path) -> None:
    frame = leaderboard()
    study, notes = read(tmp_path, frame, Columns())
    of_test = frame.drop_duplicates("test_id").set_index("test_id")
    expected = pd.get_dummies(of_test[["town", "weather"]], prefix_sep="=", dtype=float)
    expected["weather missing"] = of_test["weather"].isna().astype(float)
    expected["speed"] = of_test["speed"].astype(float).fillna(np.median(np.delete(SPEEDS, 3)))
    expected["speed missing"] = (of_test.index == "RouteScenario_3").astype(float)
    expected["turns"] = of_test["turns"].astype(float)
    found = study.rows.drop_duplicates("test_id").set_index("test_id")[list(study.features)].astype(float)
    pd.testing.assert_frame_equal(found, expected, check_like=True)
    assert list(study.axes) == ["speed", "turns"]
    reasons = dict(notes.columns.items)
    assert set(reasons) == {"save_name", "remark", "status", "route_index", "score_composed"}
    assert "13 different" in reasons["remark"]
    assert notes.features == [
        "town: a feature of 0 and 1 for each of Town01, Town02",
        "weather: a feature of 0 and 1 for each of clear, fog, rain",
        "weather missing: 1 for the 6 of 24 tests without it",
        f"speed missing: 1 for the 1 of 24 tests without it, which count as the median, {expected.speed.iloc[3]:.4g}",
    ]
    # Exported and imported again, nothing changes.
    write_rows(tmp_path / "again.csv", study)
    again = import_outcomes([tmp_path / "again.csv"], Columns())
    pd.testing.assert_frame_equal(again.rows, study.rows)
    assert (again.features, again.axes) == (study.features, study.axes)
    write_study(tmp_path, study)
    assert read_study(tmp_path).features == study.features
    named, _ = read(tmp_path, frame, Columns(features=["weather", "speed", "route_index"]))
    assert {"weather=fog", "route_index"} <= set(named.features)
    words, _ = read(tmp_path, frame, Columns(features=["town", "weather"]))
    assert list(words.axes) == ["town=Town01", "weather=clear"]  # not two words of one column
    with pytest.raises(OutcomeTableError, match="remark has 13 different words, expected numbers or at most 12 words"):
        read(tmp_path, frame, Columns(features=["remark", "speed"]))
    with pytest.raises(OutcomeTableError, match="speed is no finite number, or empty, for test RouteScenario_3"):
        read(tmp_path, frame, Columns(features=["speed", "turns"]), strict=True)


def test_rows_that_cannot_be_read_are_counted_and_named(tmp_path: Path) -> None:
    frame = leaderboard()
    frame.loc[0, "test_id"] = None  # line 2
    frame.loc[5, "simulator"] = " "  # line 7
    frame.loc[10, "failed"] = None  # line 12
    frame.loc[21, "failed"] = "aborted"  # line 23
    study, notes = read(tmp_path, frame, Columns())
    good = frame.drop(index=[0, 5, 10, 21])
    assert len(study.rows) == 44
    assert study.rows["test_id"].tolist() == good["test_id"].tolist()
    assert study.rows["failed"].tolist() == (good["failed"] == "Failed").tolist()
    assert notes.rows.line() == (
        "4 of 48 rows left out: line 2 (test_id is empty); line 7 (simulator is empty); line 12 (failed is empty); "
        "and 1 more"
    )
    with pytest.raises(OutcomeTableError, match=r"t.csv, line 2 \(test_id=nan.*: test_id is empty"):
        read(tmp_path, frame, Columns(), strict=True)


@pytest.mark.parametrize(
    ("rules", "failed", "unread"),
    [
        # status, collisions: (ok, 0), (ok, none), (none, 0), (none, 2), (bad, none), (ok, 1), (ok, 0)
        ([{"column": "status", "is_not": "ok"}, {"column": "hits", "above": 0}], [0, 0, 0, 1, 1, 1, 0], [1, 2]),
        ([{"column": "status", "is": "bad"}], [0, 0, 0, 0, 1, 0, 0], [2, 3]),
        ([{"column": "hits", "is_not": ""}], [1, 0, 1, 1, 0, 1, 1], []),
    ],
)
def test_a_verdict_is_never_guessed(
    tmp_path: Path, rules: list[dict[str, Any]], failed: list[int], unread: list[int]
) -> None:
    status, hits = ["ok", "ok", None, None, "bad", "ok", "ok"], [0, None, 0, 2, None, 1, 0]
    frame = pd.DataFrame({"test_id": range(7), "simulator": "a", "status": status, "hits": hits})
    more = frame.assign(test_id=range(7, 14), status="ok", hits=0)
    both = pd.concat([frame, *[more.assign(test_id=more.test_id + 7 * k) for k in range(3)]], ignore_index=True)
    both["x"], both["y"] = both.test_id * 1.5, both.test_id % 3
    columns = Columns.model_validate({"failed": rules, "features": ["x", "y"]})
    study, notes = read(tmp_path, both, columns)
    found = study.rows.set_index("test_id")["failed"]
    for k in set(range(7)) - set(unread):
        assert found[str(k)] == bool(failed[k])
    assert not {str(k) for k in unread} & set(found.index)
    assert [name for name, _ in notes.rows.items] == [f"line {k + 2}" for k in unread]


@pytest.mark.parametrize(("word", "said"), [("crash", "failed is 'crash', expected"), (None, "failed is empty")])
def test_leaving_out_every_failure_is_refused(tmp_path: Path, word: str | None, said: str) -> None:
    """Where all other rows say the same, leaving out those without a verdict would decide the outcome."""
    frame = leaderboard()
    frame["failed"] = [word if one == "Failed" else one for one in frame["failed"]]
    with pytest.raises(OutcomeTableError, match=f"line 2 .*{said}.*without such rows no verdict differs"):
        read(tmp_path, frame, Columns())


def test_needed_margins_and_second_tables_with_gaps(tmp_path: Path) -> None:
    rows = [(f"t{k}", sim, float(k), None if k == 4 else 0.1 * k, 7 * k % 10, k % 3) for k in range(12) for sim in "ab"]
    frame = pd.DataFrame(rows, columns=["test_id", "simulator", "run", "xte", "x", "y"])
    frame.loc[3, "run"] = None
    pd.DataFrame({"test_id": [f"t{k}" for k in range(11)] + [None], "width": range(12)}).to_csv(tmp_path / "w.csv")
    columns = Columns.model_validate({"margin": {"column": "xte", "limit": 0.55}, "repeat": "run"})
    study, notes = read(tmp_path, frame, columns, tmp_path / "w.csv")
    assert notes.rows.line() == (
        "3 of 24 rows left out: line 5 (run is no whole number from 0 to 2147483648); line 10 (xte or its limit is not "
        "a finite number); line 11 (xte or its limit is not a finite number)"
    )
    assert set(study.rows[study.rows.failed].test_id) == {f"t{k}" for k in range(6, 12)}
    of_test = study.rows.drop_duplicates("test_id").set_index("test_id")
    assert of_test.loc["t11", ["width", "width missing"]].tolist() == [np.median([*range(4), *range(5, 11)]), 1.0]


def test_maps_count_tests_not_their_repeats(tmp_path: Path) -> None:
    """By hand: three tests share a cell, driven three times each; they fail in 0, 1 and 2 of them, so one fails."""
    tests = (("a", 1.0, 0), ("b", 1.5, 1), ("c", 1.9, 2), ("d", 7.0, 3))
    rows = [(test, "x", run, run < failures, speed, 0.5) for test, speed, failures in tests for run in range(3)]
    frame = pd.DataFrame(rows, columns=["test_id", "simulator", "repeat", "failed", "speed", "curve"])
    study, _ = read(tmp_path, frame, Columns(features=["speed", "curve"], map={"speed": 5.0, "curve": 1.0}))
    cells = maps_of_study(study)[MapId.union(SimulatorName("x"))].cells
    assert {cell: (one.tests, one.failures) for cell, one in cells.items()} == {(0, 0): (3, 1), (1, 0): (1, 1)}
    assert cells[0, 0].probability == cells[0, 0].quality_loss == pytest.approx(1 / 3)


def test_types_of_parquet(tmp_path: Path) -> None:
    frame = pd.DataFrame({"test_id": range(20), "simulator": "a", "failed": [k % 3 == 0 for k in range(20)]})
    frame["kind"] = pd.Categorical([["x", "y", None][k % 3] for k in range(20)])
    frame["begun"] = pd.date_range("2024-01-01", periods=20)  # a time is no number
    frame["lit"] = pd.array([None if k == 3 else k % 2 == 0 for k in range(20)], dtype="boolean")
    frame["lanes"] = pd.array([None if k == 3 else k % 4 for k in range(20)], dtype="Int64")
    frame.to_parquet(tmp_path / "t.parquet")
    study = import_outcomes([tmp_path / "t.parquet"], Columns(), ImportNotes(rows=LeftOut("rows")))
    assert study.features == ("kind=x", "kind=y", "kind missing", "lit", "lit missing", "lanes", "lanes missing")
    assert study.rows["lit"].tolist() == [float(k % 2 == 0) if k != 3 else 1.0 for k in range(20)]
    assert study.rows["lanes"].iloc[3] == np.median([k % 4 for k in range(20) if k != 3])


def drives_once(failing: int = 20) -> pd.DataFrame:
    """Tests that one simulator drove once: two causes, and columns that the drive itself made."""
    rng = np.random.default_rng(0)
    failed = np.arange(60) < failing
    return pd.DataFrame(
        {
            "test_id": [f"t{k}" for k in range(60)],
            "simulator": "a",
            "failed": failed,
            "bend": rng.uniform(0.0, 1.0, 60).round(3),
            "speed": rng.uniform(10.0, 20.0, 60).round(2),
            "frames": np.where(failed, 200, 500) + rng.integers(0, 99, 60),
            "arrival_x": np.where(failed, 10.0, 60.0) + rng.uniform(0.0, 40.0, 60).round(2),
            "gone_after": np.where(failed, rng.uniform(1.0, 9.0, 60), np.nan),
            "how": np.where(failed, "off", "goal"),
            "duration_s": rng.uniform(10.0, 30.0, 60),
        }
    )


def test_what_only_a_drive_can_know_is_left_out_by_evidence(tmp_path: Path) -> None:
    study, notes = read(tmp_path, drives_once(), Columns())
    assert study.features == ("bend", "speed", "arrival_x")
    reasons = dict(notes.columns.items)
    assert set(reasons) == {"frames", "gone_after", "how", "duration_s"}
    assert reasons["gone_after"] == "is filled in for exactly the tests that fail"
    (said,) = notes.features  # it may be the one cause of all failures
    assert said == "arrival_x tells failing tests from others exactly: leave it out if it is known only after a drive"
    named, _ = read(tmp_path, drives_once(), Columns(features=["bend", "frames"]))
    assert named.features == ("bend", "frames")
    few, notes = read(tmp_path, drives_once(failing=4), Columns())  # too few to say
    assert {"frames", "how=off"} <= set(few.features) and dict(notes.columns.items).keys() == {"duration_s"}


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_are_numbers(tmp_path: Path, separator: str) -> None:
    frame = drives_once()[["test_id", "simulator", "failed", "bend", "speed"]].assign(place="1,5 km")
    frame.to_csv(tmp_path / "t.csv", sep=separator, decimal=",", index=False)
    study = import_outcomes([tmp_path / "t.csv"], Columns(), ImportNotes())
    assert study.features == ("bend", "speed")
    np.testing.assert_array_equal(study.rows[["bend", "speed"]], frame[["bend", "speed"]])
    frame.assign(place="1,5").to_csv(tmp_path / "t.csv", sep=separator, index=False)  # points: a comma is none
    assert read_frame(tmp_path / "t.csv")["place"].eq("1,5").all()


def arc(radius: float, degrees: float) -> list[list[float]]:
    angles = np.linspace(0.0, np.radians(degrees), 40)
    return [[float(radius * np.sin(a)), float(radius * (1 - np.cos(a)))] for a in angles]


def write(path: Path, points: list[list[float]], outcome: str, **more: object) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"id": 1, "is_valid": True, "road_points": points, "test_outcome": outcome, **more}))


def test_a_folder_of_the_competition_is_a_simulator_and_its_road_has_the_features_of_an_arc(tmp_path: Path) -> None:
    for simulator, limit in (("beamng", 30.0), ("dave2", 20.0)):
        for radius in range(15, 60, 3):
            outcome = "FAIL" if radius < limit else "PASS"
            write(tmp_path / simulator / f"test.{radius:04d}.json", arc(radius, 90.0), outcome)
        write(tmp_path / simulator / "test.9000.json", arc(40.0, 30.0), "ERROR")
        write(tmp_path / simulator / "test.9001.json", arc(41.0, 30.0), "FAIL", is_valid=False)
    write(tmp_path / "beamng" / "again.json", arc(15, 90.0), "PASS")
    study = import_outcomes([tmp_path / "beamng", tmp_path / "dave2"], Columns())
    assert study.simulators == ["beamng", "dave2"] and list(study.axes) == ["total_turn", "largest_curvature"]
    assert {name: found[:2] for name, found in study.flakiness().items()} == {"beamng": (15, 16), "dave2": (15, 15)}
    assert study.flakiness()["beamng"][3] == 1.0  # the one test that was repeated
    (tmp_path / "dave2" / "test.9002.json").write_text("{")
    notes = ImportNotes(rows=LeftOut("rows"))
    assert import_outcomes([tmp_path / "beamng", tmp_path / "dave2"], Columns(), notes).rows.equals(study.rows)
    assert notes.rows.line().startswith("1 of 32 rows left out: ") and "test.9002.json (" in notes.rows.line()
    (tmp_path / "dave2" / "test.9002.json").unlink()
    rows = read_competition([tmp_path / "dave2"])
    for radius, (_, row) in zip(range(15, 60, 3), rows.iterrows(), strict=True):
        assert row.total_turn == pytest.approx(90.0, rel=0.1)
        assert row.largest_curvature == pytest.approx(1 / radius, rel=0.2)
        assert row.length == pytest.approx(radius * np.pi / 2, rel=0.01)
        assert row.failed == (radius < 20.0)


@pytest.mark.parametrize("with_margin", [True, False])
def test_two_studies_are_compared_on_the_tests_that_both_have(tmp_path: Path, with_margin: bool) -> None:
    speed = np.linspace(5.0, 15.0, 40)
    for name, limit in (("old", 14.0), ("new", 11.0)):
        rows = [(f"t{k}", sim, v > limit, v / limit, v, k % 3) for k, v in enumerate(speed) for sim in ("a", "b")]
        frame = pd.DataFrame(rows, columns=["test_id", "simulator", "failed", "margin", "speed", "kind"])
        frame.iloc[: 80 if name == "old" else 70].to_csv(tmp_path / "t.csv", index=False)
        (tmp_path / name).mkdir()
        given = {"margin": {"column": "margin", "limit": 1.0}} if with_margin else {}
        columns = Columns.model_validate({"features": ["speed", "kind"], **given})
        write_study(tmp_path / name, import_outcomes([tmp_path / "t.csv"], columns))
    found = compare_studies(tmp_path / "old", tmp_path / "new")
    expected = sum((speed[:35] > 11.0) & (speed[:35] <= 14.0))
    for row in found.simulators:
        assert (row.counts.tests, row.counts.newly_fail, row.counts.fixed) == (35, expected, 0)
        assert (row.margin_change is None) is not with_margin
    assert answer_of(found) == "Merge? No: it is worse." and len(found.simulators) == 2
    json.dumps(document_of(found, {}), allow_nan=False)
    assert "nan" not in markdown_of(found, {}) and len(drive_table(found).rows) == 70
    frame.assign(test_id="x" + frame.test_id).to_csv(tmp_path / "t.csv", index=False)
    write_study(tmp_path / "new", import_outcomes([tmp_path / "t.csv"], columns))
    with pytest.raises(OutcomeTableError, match="share no test"):
        compare_studies(tmp_path / "old", tmp_path / "new")


def test_frames_are_the_stored_trajectories(tmp_path: Path) -> None:
    data = campaign_data(tmp_path, CampaignConfig(), 4)
    path = write_frames(tmp_path / "tables", data)
    frames = pandas.read_parquet(path)
    with closing(sqlite3.connect(tmp_path / "campaign.sqlite")) as db:
        stored = db.execute("SELECT test_id, simulator, steps, trajectory FROM executions").fetchall()
    assert len(frames) == sum(steps + 1 for _, _, steps, _ in stored)
    for test, simulator, steps, packed in stored[::7]:
        rows = frames[(frames["test_id"] == test) & (frames["simulator"] == simulator)]
        expected = np.frombuffer(zlib.decompress(packed)).reshape(-1, 5)
        assert np.array_equal(rows[["x", "y", "yaw", "speed", "lateral_position"]].to_numpy(), expected)
        assert list(rows["step"]) == list(range(steps + 1)) and rows["time"].iloc[-1] == pytest.approx(steps / 20)
        assert rows["steering"].notna().sum() == steps and np.isnan(rows["steering"].iloc[-1])
    assert write_frames(tmp_path / "again", data).read_bytes() == path.read_bytes()
    assert [field.metadata[b"unit"].decode() for field in pq.read_schema(path)] == [u for _, u, _ in COLUMNS.values()]
    assert pq.read_table(write_frames(tmp_path / "none", CampaignData(config=data.config))).num_rows == 0


def test_an_export_has_a_column_for_each_condition_that_was_changed(tmp_path: Path) -> None:
    roads = [generate(np.random.default_rng(seed)) for seed in range(4)]
    conditions = [DEFAULT, Conditions(visibility=60.0), Conditions(friction=0.5, speed_limit=8.0), DEFAULT]
    states = np.array([[1, 2]] * 4, np.int8)
    table = RoadTable.of(
        roads, states, np.ones((4, 2)), siblings=[SimulatorName("a"), SimulatorName("b")], conditions=conditions
    )
    study = study_of(table)
    write_study(tmp_path, study)
    of_a = pandas.read_parquet(tmp_path / "outcomes.parquet").query("simulator == 'a'")
    assert of_a["condition_visibility"].tolist() == [np.inf, 60.0, np.inf, np.inf]
    assert of_a["condition_friction"].tolist() == [1.0, 1.0, 0.5, 1.0]
    assert of_a["condition_speed_limit"].isna().tolist() == [True, True, False, True]
    assert of_a["condition_speed_limit"].iloc[2] == 8.0
    assert len([name for name in of_a if name.startswith("condition_")]) == 3
    assert read_study(tmp_path).features == table.feature_names  # as before: shares of ranges
    for suffix in ("csv", "parquet"):  # no feature either when it comes back
        write_rows(tmp_path / f"t.{suffix}", read_study(tmp_path))
        again = import_outcomes([tmp_path / f"t.{suffix}"], Columns())
        pandas.testing.assert_frame_equal(again.rows, study.rows, check_dtype=False)
        assert again.conditions == study.conditions
