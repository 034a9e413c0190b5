# SPDX-License-Identifier: Apache-2.0
"""Verbs that predict a car: what they print and write, and one line for bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ds_cli.application import run
from ds_road import Road, generate, write_roads

ROADS = [generate(np.random.default_rng(seed)) for seed in range(40)]


def write_comparison(folder: Path, roads: list[Road] = ROADS) -> Path:
    """A comparison as `ds siblings compare --out` writes it: failures grow with the curvature of the right lane."""
    rng = np.random.default_rng(21)
    names = ("bullet", "softbody", "panda", "donkey")
    hard = np.array([road.lane_curvature_max_right for road in roads])
    level = np.array([-0.3, -0.2, -0.1, 0.0])
    margins = level + 2.0 * (hard / np.median(hard) - 1.0)[:, None] + 0.2 * rng.normal(size=(len(roads), 4))
    rows = [
        {
            "road_id": road.road_id,
            "failed": {name: bool(margins[k, s] > 0) for s, name in enumerate(names)},
            "max_lateral_position": {
                name: float(min(2.0 * np.exp(margins[k, s]), 2.0)) for s, name in enumerate(names)
            },
        }
        for k, road in enumerate(roads)
    ]
    folder.mkdir(exist_ok=True)
    document = {"simulators": dict.fromkeys(names, {}), "outcomes": rows}
    (folder / "siblings.json").write_text(json.dumps(document))
    write_roads(roads, folder / "roads.json")
    return folder


@pytest.fixture
def compared(tmp_path: Path) -> Path:
    return write_comparison(tmp_path / "compared")


def test_a_comparison_is_predicted(compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert run(["predict", str(compared), "--twin", "donkey", "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["siblings"] == ["bullet", "softbody", "panda"] and document["twin"] == "donkey"
    assert document == json.loads((out / "prediction.json").read_text())
    names = {score["predictor"] for score in document["comparison"]["scores"]}
    assert {"bullet", "softbody", "panda", "product", "mean", "features alone", "prediction"} <= names
    assert len(document["verdicts"]["tests"]) == 40
    written = {path.name for path in out.iterdir()}
    assert {"verdicts.png", "cell_verdicts.csv", "predictors.tex", "predictor_reliability.csv"} <= written
    assert run(["predict", str(compared), "--twin", "donkey"]) == 0
    text, said = capsys.readouterr()
    assert text.startswith("On donkey, never driven, ") and "is meant to be wrong at most 5% of the" in text
    assert "\nnext: " in said and len(text.splitlines()) < 25 and "features alone" not in text
    assert run(["predict", str(compared), "--twin", "donkey", "--tables"]) == 0
    assert "features alone" in capsys.readouterr().out


def test_without_a_twin_the_car_is_predicted_and_nothing_compared(
    compared: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["predict", str(compared), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["twin"] is None and document["comparison"] is None and len(document["siblings"]) == 4
    assert "there is no twin" in document["no_comparison"]
    assert all(0.0 < test["probability"] < 1.0 for test in document["verdicts"]["tests"])


def test_bad_input_is_one_line(compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    former = write_comparison(tmp_path / "former")  # until 0.2 the file had the name of another verb's
    (former / "siblings.json").rename(former / "comparison.json")
    assert run(["predict", str(former), "--json"]) == 0
    capsys.readouterr()
    networks = tmp_path / "networks"
    networks.mkdir()
    (networks / "comparison.json").write_text('{"version": 1, "tests": [], "simulators": {}}')
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    (damaged / "comparison.json").write_text('{"outcomes": 3}')
    for named, arguments in (
        ("holds no campaign.sqlite, siblings.json or outcomes.parquet", ["predict", str(tmp_path)]),
        ("no simulator 'carla', expected one of bullet", ["predict", str(compared), "--twin", "carla"]),
        ("holds no comparison: expected", ["predict", str(damaged)]),
        ("expected the --out of `ds siblings compare`", ["predict", str(networks)]),
    ):
        assert run(arguments) == 2
        captured = capsys.readouterr()
        lines = [line for line in captured.err.splitlines() if line.startswith("error")]
        assert captured.out == "" and len(lines) == 1 and named in lines[0], captured.err


def test_too_few_tests_still_have_failure_rates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = write_comparison(tmp_path / "few", ROADS[:6])
    counts = {
        name: sum(row["failed"][name] for row in json.loads((few / "siblings.json").read_text())["outcomes"])
        for name in ("bullet", "softbody", "panda", "donkey")
    }
    assert run(["predict", str(few)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("no prediction: 6 tests have a verdict on a sibling, expected at least 10")
    assert all(f"{name} fails {failures} of 6 tests (" in text for name, failures in counts.items())
    assert run(["predict", str(few), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["simulators"]
    assert {name: one["failures"] for name, one in found.items()} == counts
