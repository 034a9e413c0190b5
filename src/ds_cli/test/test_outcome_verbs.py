# SPDX-License-Identifier: Apache-2.0
"""What `ds outcomes` and `ds maps` print of tables of others."""

from __future__ import annotations

import io
import re
import shlex
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from rich.console import Console

from ds_analysis.outcomes.study import read_study
from ds_cli.application import run
from ds_cli.maps import grids
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId
from ds_orchestrator.search.features import Cell, column_axis
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
