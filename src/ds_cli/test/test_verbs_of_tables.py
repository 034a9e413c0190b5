# SPDX-License-Identifier: Apache-2.0
"""Verbs of tables of others, and those that predict a car, before and after it drives."""

from __future__ import annotations

import csv
import io
import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from tests.command_line import document, ds, refusal

from ds_analysis.outcomes.study import read_study
from ds_analysis.real.proposal import read_proposed
from ds_analysis.real.records import read_drives
from ds_cli.application import run
from ds_cli.maps import grids
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId
from ds_orchestrator.search.features import Cell, column_axis
from ds_road import Road, generate, write_roads
from ds_sim import SimulatorName


@pytest.mark.parametrize("width", [40, 80, 100, 133])
def test_a_grid_as_wide_as_the_terminal_shows_every_cell(width: int) -> None:
    cells: dict[Cell, MapCell] = {
        (k, 3): MapCell(tests=1000 + k, failures=100 * k, probability=k / 20, quality_loss=0.0) for k in range(3, 20)
    }
    axes = (column_axis("speed", 1.0), column_axis("curvature", 0.02))
    made = FeatureMap(id=MapId.union(SimulatorName("a")), cells=cells, features=axes, excluded={(7, 3): 12})
    console = Console(width=width, file=io.StringIO())
    for grid in grids(made, width):
        console.print(grid)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert re.findall(r"\d+/\d+", text) == [f"{100 * k}/{1000 + k}" for k in range(3, 20)]
    assert "-12" in text and "0.06" in text and "…" not in text


TESTS = range(12)
FAILED = {("carla", k): k % 3 == 0 for k in TESTS} | {("lgsvl", k): k % 4 == 0 for k in TESTS}


def long_table(**columns: Any) -> pd.DataFrame:
    """Twelve tests on two simulators; a function of simulator and test, or a constant, for each column."""
    rows = [{name: of(sim, k) for name, of in columns.items()} for sim, k in FAILED]
    return pd.DataFrame(rows).assign(speed=[k + 0.5 for _, k in FAILED], curve=[k % 5 for _, k in FAILED])


def test_usual_names_are_understood(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = long_table(
        Scenario_ID=lambda sim, k: f"s{k}",
        sim=lambda sim, k: sim,
        outcome=lambda sim, k: "FAIL" if FAILED[sim, k] else {5: None, 7: "ERROR"}.get(k, "PASS"),
        weather=lambda sim, k: None if k == 2 else ["rain", "fog"][k % 2],
    )
    table.to_csv(tmp_path / "t.csv", index=False)
    assert run(["outcomes", "import", f"{tmp_path}/t.csv", "--out", f"{tmp_path}/study"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said[:2] == [
        "by usual names: failed is outcome, test is Scenario_ID, simulator is sim",
        "4 of 24 rows left out: line 7 (outcome is empty); line 9 (outcome is 'error'); line 19 (outcome is empty); "
        "and 1 more",
    ]
    rows = read_study(tmp_path / "study").rows
    found = {(row.simulator, int(row.test_id[1:])): row.failed for row in rows.itertuples()}
    assert found == {key: failed for key, failed in FAILED.items() if key[1] not in (5, 7)}
    for verb in ("maps", "predict", "report"):
        assert run([verb, f"{tmp_path}/study"]) == 0
    assert "weather=rain" in (tmp_path / "study/report.html").read_text()
    assert run(["outcomes", "import", "--strict", f"{tmp_path}/t.csv", "--out", f"{tmp_path}/other"]) == 2
    assert "t.csv, line 7 (" in capsys.readouterr().err and not (tmp_path / "other").exists()


OPPOSITE = long_table(
    case=lambda sim, k: k,
    engine=lambda sim, k: sim,
    success=lambda sim, k: None if k == 5 else float(not FAILED[sim, k]),
)
STATUS = long_table(
    route=lambda sim, k: k,
    fps=lambda sim, k: 10 if sim == "carla" else 20,
    status=lambda sim, k: "Failed - stuck" if FAILED[sim, k] else "Completed",
)
MARGIN = long_table(
    road=lambda sim, k: k, simulator=lambda sim, k: sim, max_xte_m=lambda sim, k: 1.5 if FAILED[sim, k] else 0.5
)
WIDE = pd.DataFrame(
    [(k, k + 0.5, k % 5, int(FAILED["carla", k]), int(FAILED["lgsvl", k])) for k in TESTS],
    columns=["number", "speed", "curve", "Critical_carla", "Critical_lgsvl"],
)


@pytest.mark.parametrize(
    ("table", "asked", "comment"),
    [
        (OPPOSITE, False, ""),
        (STATUS, True, 'failed: {column: "status", is_not: "Completed"}'),
        (MARGIN, True, 'margin: {column: "max_xte_m", limit: LIMIT}'),
        (WIDE, False, ""),
        (OPPOSITE[:12].drop(columns="engine"), False, ""),
        (STATUS[:12].drop(columns="fps"), True, 'simulators: {"t": {failed: {column: "status", is_not: "Completed"}}}'),
    ],
    ids=["opposite", "status", "margin", "wide", "one simulator", "one simulator's status"],
)
def test_what_is_guessed_is_written_and_the_next_command_works(
    table: pd.DataFrame, asked: bool, comment: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table.to_csv(tmp_path / "t.csv", index=False)
    words = ["outcomes", "import", f"{tmp_path}/t.csv", "--out", f"{tmp_path}/study"]
    assert run(words) == 2
    seen = capsys.readouterr()
    file = tmp_path / "study/columns.yaml"
    assert seen.err.startswith(f"{tmp_path}/t.csv: wrote {file} ") and ("fill in failed" in seen.err) is asked
    assert not (tmp_path / "study/outcomes.parquet").exists()
    assert run(words) == 2 and "columns.yaml exists" in capsys.readouterr().err  # what somebody edited is kept
    following = shlex.split(seen.err.rpartition("next: ")[2])[1:]
    if asked:  # nobody guesses a verdict
        assert run(following) == 2
        assert f"\n# {comment}\n" in file.read_text()
        file.write_text(file.read_text().replace(f"# {comment}", comment.replace("LIMIT", "1.0")))
    assert run(following) == 0
    rows = read_study(tmp_path / "study").rows
    names = {"10": "carla", "20": "lgsvl", "t": "carla", "carla": "carla", "lgsvl": "lgsvl"}
    found = {(names[row.simulator], int(row.test_id)): row.failed for row in rows.itertuples()}
    simulators = {"carla"} if len(table) == 12 and table is not WIDE else {"carla", "lgsvl"}
    unread = {5} if "success" in table else set()
    assert found == {key: failed for key, failed in FAILED.items() if key[0] in simulators and key[1] not in unread}


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
            "failed": dict(zip(names, (margins[k] > 0).tolist(), strict=True)),
            "max_lateral_position": dict(zip(names, np.minimum(2.0 * np.exp(margins[k]), 2.0).tolist(), strict=True)),
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


def test_a_comparison_is_predicted(compared: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    predicted = document("predict", compared, "--twin", "donkey", "--out", out)
    assert predicted["siblings"] == ["bullet", "softbody", "panda"] and predicted["twin"] == "donkey"
    assert predicted == json.loads((out / "prediction.json").read_text())
    names = {score["predictor"] for score in predicted["comparison"]["scores"]}
    assert {"bullet", "softbody", "panda", "product", "mean", "features alone", "prediction"} <= names
    assert len(predicted["verdicts"]["tests"]) == 40
    written = {path.name for path in out.iterdir()}
    assert {"verdicts.png", "cell_verdicts.csv", "predictors.tex", "predictor_reliability.csv"} <= written
    done = ds("predict", compared, "--twin", "donkey")
    text, said = done.stdout, done.stderr
    assert done.returncode == 0 and text.startswith("On donkey, never driven, ")
    assert "is meant to be wrong at most 5% of the" in text
    assert "\nnext: " in said and len(text.splitlines()) < 25 and "features alone" not in text
    assert "features alone" in ds("predict", compared, "--twin", "donkey", "--tables").stdout


def test_without_a_twin_the_car_is_predicted_and_nothing_compared(compared: Path) -> None:
    predicted = document("predict", compared)
    assert predicted["twin"] is None and predicted["comparison"] is None and len(predicted["siblings"]) == 4
    assert "there is no twin" in predicted["no_comparison"]
    assert all(0.0 < test["probability"] < 1.0 for test in predicted["verdicts"]["tests"])


def test_bad_input_is_one_line(compared: Path, tmp_path: Path) -> None:
    former = write_comparison(tmp_path / "former")  # until 0.2 the file had the name of another verb's
    (former / "siblings.json").rename(former / "comparison.json")
    assert document("predict", former)
    assert "holds no campaign.sqlite, siblings.json or outcomes.parquet" in refusal("predict", tmp_path)
    assert "no simulator 'carla', expected one of bullet" in refusal("predict", compared, "--twin", "carla")
    (former / "comparison.json").write_text('{"outcomes": 3}')
    assert "holds no comparison: expected" in refusal("predict", former)
    (former / "comparison.json").write_text('{"version": 1, "tests": [], "simulators": {}}')
    assert "expected the --out of `ds siblings compare`" in refusal("predict", former)


def test_too_few_tests_still_have_failure_rates(tmp_path: Path) -> None:
    few = write_comparison(tmp_path / "few", ROADS[:6])
    counts = {
        name: sum(row["failed"][name] for row in json.loads((few / "siblings.json").read_text())["outcomes"])
        for name in ("bullet", "softbody", "panda", "donkey")
    }
    text = ds("predict", few).stdout
    assert text.startswith("no prediction: 6 tests have a verdict on a sibling, expected at least 10")
    assert all(f"{name} fails {failures} of 6 tests (" in text for name, failures in counts.items())
    found = document("predict", few)["simulators"]
    assert {name: one["failures"] for name, one in found.items()} == counts


def test_drives_are_proposed_recorded_and_used(compared: Path) -> None:
    before = (compared / "siblings.json").read_bytes()
    proposed = document("real", "propose", compared, "--drives", 3)["drives"]
    place = compared / "real/round_1"
    assert len(list(place.glob("*.png"))) == 3 and len(list(place.glob("[123]_*.csv"))) == 3
    text = (place / "README.md").read_text()
    assert all(one["test_id"] in text and one["drawn"] for one in proposed)
    # The siblings fail half of the time; the car never does.
    rows = list(csv.reader((place / "outcomes.csv").read_text().splitlines()))
    filled = place / "filled.csv"
    rows[1:] = [[row[0], "completed", "Ada", "2026-03-01", "0.01", ""] for row in rows[1:]]
    filled.write_text("\n".join(map(",".join, rows)))
    recorded = document("real", "record", compared, filled)
    assert recorded["failures"][1] < recorded["failures"][0] - 0.05
    assert recorded["certificate"]["drawn"] == 3 and recorded["certificate"]["high"] < recorded["certificate"]["tests"]
    assert recorded["help"]["drives"] == 3 and recorded["help"]["answer"] == "open" and recorded["open"] == []
    driven = {one["test_id"] for one in recorded["verdicts"]["tests"] if one["driven"]}
    assert driven == {one["test_id"] for one in proposed}
    assert [drive.who for drive in read_drives(compared)] == ["Ada"] * 3
    # A drive decides its test, but alone no cell.
    cells = [one for one in recorded["verdicts"]["cells"] if one["driven"] == one["tests"] == 1]
    assert all(0.0 < one["rate"] < one["interval"][1] for one in cells)
    assert {"before.png", "after.png", "update.json"} <= {path.name for path in (compared / "real").iterdir()}
    # Again, which changes nothing; then further drives, which are others.
    shown = ds("real", "record", compared, filled).stdout
    assert "The car drove 3 tests and failed 0" in shown and "it is open whether your simulators" in shown
    assert "Certain with 95%, whenever you stop: the car fails on 0 to " in shown
    more = {one["test_id"] for one in document("real", "propose", compared, "--drives", 3)["drives"]}
    assert not more & driven and len(read_proposed(compared).tests) == 6
    assert (compared / "siblings.json").read_bytes() == before


def test_bad_requests_are_one_line(compared: Path, tmp_path: Path) -> None:
    file = tmp_path / "drives.csv"
    file.write_text("test_id,outcome,who,when\na,completed,Ada,2026-03-01\n")
    propose = ("real", "propose", compared, "--drives")
    assert "there is no test 'a'" in refusal("real", "record", compared, file)
    assert "40 tests can be proposed, expected a budget of at most 40" in refusal(*propose, 41)
    assert "--drives" in refusal(*propose, 0)
    assert "has no real drives" in refusal("real", "update", compared)
    assert ds(*propose, 1).returncode == 0
    assert "which test is it? expected --test with one of" in refusal("real", "record", compared, tmp_path)
    assert "drives of a car of 1:16 were proposed before" in refusal(*propose, 1, "--scale", 10)
    (compared / "real/drives.json").write_text("[{}]")
    assert "drives.json cannot be read" in refusal("real", "update", compared)
