# SPDX-License-Identifier: Apache-2.0
"""The page of imported outcomes: what it says, what it escapes, the same bytes again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from ds_analysis.outcomes.columns import Columns
from ds_analysis.outcomes.maps import maps_of_study
from ds_analysis.outcomes.study import import_outcomes, write_study
from ds_orchestrator.maps.feature_map import MapId
from ds_report.study_page import write_study_page
from ds_sim import SimulatorName

CAR, OTHER = map(SimulatorName, ("car", "other"))

HOSTILE = "<script>alert(1)</script>"


def table(folder: Path, tests: int) -> Path:
    rng = np.random.default_rng(3)
    speed, curve = rng.uniform(5, 20, tests), rng.uniform(0, 0.2, tests)
    rows = [
        (test, simulator, int(speed[test] * level > 12), speed[test], curve[test])
        for test in range(tests)
        for simulator, level in ((HOSTILE, 1.0), ("other", 1.2), ("car", 0.9))
    ]
    frame = pd.DataFrame(rows, columns=["test_id", "simulator", "failed", "speed", "curve"])
    frame.to_csv(folder / "t.csv", index=False)
    return folder / "t.csv"


def test_a_page_says_where_each_simulator_fails_and_runs_nothing(tmp_path: Path) -> None:
    study = import_outcomes([table(tmp_path, 60)], Columns(twin=CAR))
    write_study(tmp_path, study)
    text = write_study_page(tmp_path, study).read_text()
    assert HOSTILE not in text and "&lt;script&gt;" in text and "default-src 'none'" in text
    assert "where speed is " in text and "did not choose this threshold" in text
    assert "real propose" in text and text.count("data:image/png") == 5
    assert "predicted without driving it" in text  # predictors are scored on the twin
    assert write_study_page(tmp_path, study).read_text() == text


def test_too_few_tests_still_have_maps_and_counts(tmp_path: Path) -> None:
    study = import_outcomes([table(tmp_path, 4)], Columns())
    text = write_study_page(tmp_path, study).read_text()
    assert "expected at least 10" in text and "What was read" in text


def test_maps_count_every_test_and_merge_by_every_operator(tmp_path: Path) -> None:
    study = import_outcomes([table(tmp_path, 60)], Columns(twin=CAR, map={"speed": 5.0, "curve": 0.1}))
    maps = maps_of_study(study)
    rows = study.rows
    for map_id in (MapId.union(OTHER), MapId.twin(CAR)):
        own = rows[rows["simulator"] == map_id.simulator]
        for cell, content in maps[map_id].cells.items():
            inside = own[(own["speed"] // 5 == cell[0]) & (own["curve"] // 0.1 == cell[1])]
            assert (content.tests, content.failures) == (len(inside), int(inside["failed"].sum()))
        assert sum(content.tests for content in maps[map_id].cells.values()) == 60
    one, other = maps[MapId.union(SimulatorName(HOSTILE))], maps[MapId.union(SimulatorName("other"))]
    for cell, content in maps[MapId.merged()].cells.items():
        assert content.probability == one.cells[cell].probability * other.cells[cell].probability
    by_other_axes = maps_of_study(study, ["curve", "speed"])
    assert sum(content.tests for content in by_other_axes[MapId.union(OTHER)].cells.values()) == 60
