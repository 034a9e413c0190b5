# SPDX-License-Identifier: Apache-2.0
"""Outcomes from elsewhere: tables in, one line where they are wrong, the same table out again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from ds_analysis.common.outcome_table import OutcomeTableError, State
from ds_analysis.outcomes.columns import Columns, read_columns
from ds_analysis.outcomes.known_before import ImportNotes
from ds_analysis.outcomes.reading import read_table
from ds_analysis.outcomes.study import Study, import_outcomes, read_study, write_rows, write_study
from ds_analysis.prediction.car import predict_car
from ds_analysis.prediction.mixture import predict
from ds_analysis.real.proposal import propose
from ds_analysis.real.records import read_drives
from ds_base.left_out import LeftOut
from ds_report.study_page import write_study_page
from ds_sim import SimulatorName

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


def imported(folder: Path, frame: pd.DataFrame, columns: dict[str, Any] | None, *more: Path) -> Study:
    frame.to_csv(folder / "t.csv", index=False)
    if columns is None:
        return import_outcomes([folder / "t.csv", *more], Columns())
    (folder / "c.yaml").write_text(yaml.safe_dump(columns))
    return import_outcomes([folder / "t.csv", *more], read_columns(folder / "c.yaml"))


def test_a_long_table_becomes_the_outcomes_that_it_states(tmp_path: Path) -> None:
    frame = long_table()
    study = imported(tmp_path, frame, LONG)
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
    study = imported(tmp_path, wide, columns, tmp_path / "f.csv")
    found = {(row.test_id, row.simulator): row.failed for row in study.rows.itertuples()}
    assert found == {
        ("1-0", "lo"): False,
        ("1-1", "lo"): True,
        ("2-0", "lo"): False,
        ("1-0", "hi"): False,
        ("1-1", "hi"): True,
        ("2-0", "hi"): True,
    }
    assert study.rows["length"].tolist() == [3.0, 4.0, 5.0] * 2 and np.isnan(study.rows["margin"]).all()


def test_a_verdict_alone_bounds_the_margin_at_the_limit(tmp_path: Path) -> None:
    frame = long_table()
    frame["failed"] = frame.xte > 1.2
    study = imported(tmp_path, frame.drop(columns="xte"), {**LONG, "margin": None, "failed": "failed"})
    table, known = study.table(), imported(tmp_path, frame, LONG).table()
    assert np.isnan(table.lateral[:, :2]).all() and np.array_equal(table.states, known.states)
    # Margins say more: a prediction from them differs, and both are finite.
    one, two = (predict(each).probabilities() for each in (table, known))
    assert np.isfinite(one).all() and np.isfinite(two).all() and not np.allclose(one, two)


def test_a_car_s_rows_are_its_drives(tmp_path: Path) -> None:
    """20 of 40 tests were driven on the car: never a sibling, never proposed again, counted unasked."""
    frame = long_table()
    frame = frame[(frame.sim != "car") | (frame.route < 20)]
    study = imported(tmp_path, frame, {**LONG, "twin": None, "car": "car"})
    write_study(tmp_path, study)
    table, drives = read_table(tmp_path), read_drives(tmp_path)
    assert table.simulators == ("lofi", "hifi") and len(table) == 40 and len(drives) == 20
    truth = frame[frame.sim == "car"].groupby("route").xte.median() > 1.2
    assert {int(one.test_id): one.failed for one in drives} == truth.to_dict() and not any(one.drawn for one in drives)
    car = predict_car(tmp_path, table)
    assert car.sentence.startswith("Of the 20 tests that the car has not driven, ") and car.certificate is None
    assert (
        f"The car drove 20 tests and failed {int(truth.sum())}" in car.sentence and "without a real" not in car.sentence
    )
    (tmp_path / "real").mkdir()
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
    folder = tmp_path / "wide"
    folder.mkdir()
    write_study(folder, imported(folder, wide, columns))
    certificate = predict_car(folder, read_table(folder)).certificate
    assert certificate is not None and (certificate.drawn, certificate.tests) == (20, 40)
    assert certificate.low <= int(truth.sum()) + 10 and certificate.high < 40


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_export_and_import_are_inverse(tmp_path: Path, suffix: str) -> None:
    study = imported(tmp_path, long_table(), LONG)
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
    study = imported(tmp_path, frame.drop(columns="xte"), {**LONG, "margin": None, "failed": "failed"})
    assert study.flakiness()["car"] == (40, 80, 0.125, 0.25) and study.flakiness()["lofi"][3] == 0.0


def changed(**values: Any) -> dict[str, Any]:
    return {**LONG, **values}


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (changed(test="id"), r"has no column 'id', but route, sim, rep, xte.*: say in --columns which is what"),
        (changed(margin={"column": "xte", "limit": {"lofi": 1.0}}), "margin.limit names no limit for hifi"),
        (changed(margin=None, failed="sim"), r"line 2 \(route=0, sim=lofi, .*: sim is 'lofi', expected true or false"),
        (changed(repeat=None), "test 0 comes twice on lofi: name the column of the repetition"),
        (changed(features=["sim"]), "sim differs between drives of 40 tests, as 0: it is no feature"),
        (changed(twin="bus"), "has no simulator 'bus': expected car, hifi, lofi"),
        (changed(car="bus"), "has no simulator 'bus': expected car, hifi, lofi"),
        (changed(car="car"), "the car is 'car': expected a simulator beside it, and no twin"),
        (changed(map={"speed": 1.0, "age": 1.0}), "axis 'age' is no feature: expected speed, curve"),
        (changed(map={"speed": 1e-6, "curve": 0.1}), "bins of 1e-06 cut speed into more than 200: widen them"),
        (changed(features=["speed"]), "has one feature, speed: expected two or more"),
        (changed(where=[{"column": "rep", "above": 9}]), "has no rows where they have to be"),
        (changed(margin={"column": "xte", "limit": "1.1 m"}), "margin.limit is '1.1 m', expected a number"),
        (changed(margin=None, failed={"column": "sim", "is": "LOFY"}), "sim is never 'LOFY', but car, hifi, lofi"),
        (changed(where=[{"column": "rep"}]), "where.0: expected one of is, is_not, above and below"),
        (changed(tests="route"), r"tests: Extra inputs are not permitted \(keys: test, simulator, simulators"),
        (changed(margin=None), "name the column that says whether a test failed"),
    ],
)
def test_what_is_wrong_gets_one_line(tmp_path: Path, columns: dict[str, Any], said: str) -> None:
    with pytest.raises(OutcomeTableError, match=said) as raised:
        imported(tmp_path, long_table(), {key: value for key, value in columns.items() if value is not None})
    assert "\n" not in str(raised.value)


def test_a_number_that_differs_between_drives_of_a_test_is_no_feature(tmp_path: Path) -> None:
    rows = [
        f"t{n},{sim},{run},{int(n > 20)},{0.01 * n},{5 + n % 7},{30 + run + 0.1 * n}"
        for n in range(30)
        for sim in "ab"
        for run in (1, 2)
    ]
    path = tmp_path / "t.csv"
    path.write_text("test_id,simulator,run,failed,curve,speed,duration_s\n" + "\n".join(rows))
    left_out = LeftOut("columns")
    study = import_outcomes([path], Columns(repeat="run"), ImportNotes(columns=left_out))
    assert study.features == ("curve", "speed")
    assert left_out.line().startswith("1 of 3 columns left out: duration_s (differs between drives of 30")
    with pytest.raises(OutcomeTableError, match="differs between drives of 30 tests, as t0: it is no feature"):
        import_outcomes([path], Columns(repeat="run", features=["curve", "duration_s"]))
