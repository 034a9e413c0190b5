# SPDX-License-Identifier: Apache-2.0
"""The page of imported outcomes: what it says, what it escapes, the same bytes again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from ds_analysis.outcomes.columns import Columns
from ds_analysis.outcomes.study import import_outcomes, write_study
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
