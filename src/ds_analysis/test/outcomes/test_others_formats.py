# SPDX-License-Identifier: Apache-2.0
"""Test files of SBFT's competition become a study; two studies of the same tests are compared."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ds_analysis.common.outcome_table import OutcomeTableError
from ds_analysis.comparison.analysis import answer_of
from ds_analysis.comparison.tables import document_of, drive_table, markdown_of
from ds_analysis.outcomes.columns import Columns
from ds_analysis.outcomes.known_before import ImportNotes
from ds_analysis.outcomes.sbft import read_competition
from ds_analysis.outcomes.study import import_outcomes, write_study
from ds_analysis.outcomes.study_results import compare_studies
from ds_base.left_out import LeftOut


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
