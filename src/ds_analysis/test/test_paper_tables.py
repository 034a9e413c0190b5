# SPDX-License-Identifier: Apache-2.0
"""Tables as CSV that reads back, as LaTeX that compiles, and with the paper's numbers in the right rows."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from ds_analysis.paper.correlation import Correlation, PairedDifference, RobustnessCheck
from ds_analysis.paper.paper_tables import correlation_tables, paired_difference_table, robustness_table, role_of
from ds_base.table import Column, Table, TableError, keep_tables, read_tables, shown
from ds_orchestrator.maps.feature_map import MapId
from ds_sim import BULLET, DONKEY, SOFTBODY

TABLE = Table(
    name="t",
    title="50 % of a_b & {c}",
    columns=[Column("name"), Column("r", "number"), Column("95 %", "number"), Column("p", "p"), Column("n", "count")],
    rows=[["x, y_1", -0.123456789, (-0.5, 0.25), 3.2e-7, 12], ["z", None, None, 0.025, 3]],
    notes=["100 % sure"],
)


def test_csv_keeps_every_digit() -> None:
    rows = list(csv.DictReader(io.StringIO(TABLE.csv())))
    assert [float(rows[0][name]) for name in ("r", "95 %, low", "95 %, high")] == [-0.123456789, -0.5, 0.25]
    assert rows[0]["name"] == "x, y_1" and float(rows[0]["p"]) == 3.2e-7
    assert rows[1]["r"] == rows[1]["95 %, low"] == "" and rows[1]["n"] == "3"


def test_latex_escapes_and_balances() -> None:
    text = TABLE.latex()
    numbers = (r"$3 \cdot 10^{-7}$", "0.025", "$-0.123$", " -- ", "[$-0.500$, $0.250$]")
    for part in (r"\caption{50 \% of a\_b \& \{c\}}", r"x, y\_1", *numbers):
        assert part in text
    body = text[text.index(r"\toprule") : text.index(r"\bottomrule")]
    assert [len(re.findall(r"(?<!\\)&", line)) for line in body.splitlines() if line.endswith(r"\\")] == [4, 4, 4]
    assert text.count(r"\begin") == text.count(r"\end") == 2


def test_shown_numbers_are_short() -> None:
    assert TABLE.texts() == [["x, y_1", "-0.123", "[-0.500, 0.250]", "< 0.001", "12"], ["z", "", "", "0.025", "3"]]
    assert shown(0.0123456, "small") == "0.01235" and shown(None, "number") == ""
    out = io.StringIO()
    TABLE.show(Console(file=out, width=40))
    assert "[-0.500, 0.250]" in out.getvalue() and "100 % sure" in out.getvalue()


def test_a_p_value_is_never_0() -> None:
    for value in (0.0, 5e-324, 9e-301):
        assert shown(value, "p") == "< 0.001"
        table = Table(name="t", title="t", columns=[Column("p", "p")], rows=[[value]])
        assert r"$< 10^{-300}$ \\" in table.latex() and float(table.csv().splitlines()[1]) == value
    assert [shown(p, "p") for p in (1e-300, 9e-4, 0.001)] == ["< 0.001", "< 0.001", "0.001"]


def test_kept_tables_come_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "kept.json"
    assert read_tables(path) == []
    keep_tables([TABLE, TABLE], path)
    for table in read_tables(path):
        assert (table.texts(), table.csv(), table.latex()) == (TABLE.texts(), TABLE.csv(), TABLE.latex())
    for broken in ("[", '[{"name": "t"}]', "3"):
        path.write_text(broken)
        with pytest.raises(TableError, match="kept.json cannot be read .*: remove it"):
            read_tables(path)


@pytest.mark.parametrize("damage", [{"rows": [["x"]]}, {"rows": [["x", float("nan")]]}, {"title": None}])
def test_damaged_tables_are_refused(tmp_path: Path, damage: dict[str, object]) -> None:
    table = {"name": "rq1", "title": "t", "columns": [{"name": "a"}, {"name": "b"}], "rows": [["x", 1]], "notes": []}
    path = tmp_path / "rq1.json"
    path.write_text(json.dumps([table | damage]))
    with pytest.raises(TableError, match=r"rq1\.json cannot be read .*: remove it"):
        read_tables(path)


def test_the_papers_numbers_are_in_the_campaigns_rows() -> None:
    ids = [MapId.union(SOFTBODY), MapId.union(BULLET), MapId.merged()]
    known: dict[str, Any] = {"r": 0.4, "p": 0.01, "r_interval": (0.3, 0.5)}
    unknown = {"r": None, "p": None, "reason": "why"}
    rows = [
        Correlation(map=map_id, value=value, cells=9, auc=0.5, auc_interval=(0.2, 0.8), baseline=0.25, **of_r)
        for value in ("probability", "quality_loss")
        for map_id, of_r in zip(ids, (known, known, unknown), strict=True)
    ]
    rq2, rq3 = correlation_tables(rows, [SOFTBODY, BULLET], DONKEY, ("epoch", "real"))
    at = {c.name: k for k, c in enumerate(rq2.columns)}
    assert [row[0] for row in rq2.rows] == ["DS1", "DS2", "DSS"]
    assert [row[at["paper: r"]] for row in rq2.rows] == [0.469, 0.521, 0.450]
    assert [row[at["paper: AUC-PRC"]] for row in rq3.rows] == [0.608, 0.715, 0.651]
    assert any("DSS: no r, why" in note for note in rq2.notes) and any("25%" in note for note in rq2.notes)
    ours, _ = correlation_tables(rows, [SOFTBODY, BULLET], DONKEY, None)
    assert len(ours.columns) == len(rq2.columns) - 3
    # A third sibling has no counterpart in the paper.
    assert role_of("x", ["a", "b", "x"]) == "DS3" and role_of("", ["a"]) == "DSS"


def test_what_merging_adds_names_the_sibling() -> None:
    gain = PairedDifference(
        over=MapId.union(BULLET), value="quality_loss", cells=9, r=-0.1, r_interval=(-0.3, 0.1), auc=-1e-17
    )
    assert paired_difference_table([gain], [DONKEY, BULLET]).texts() == [
        ["RQ3", "DS2 bullet", "9", "-0.100", "[-0.300, 0.100]", "0.000", ""]
    ]


def test_robustness_checks_are_one_row_each() -> None:
    twin = MapId.twin(DONKEY)
    check = RobustnessCheck(what="w", map=MapId.merged(), against=twin, value="quality_loss", cells=4, r=0.5)
    table = robustness_table([check], ["too few cells fail"])
    assert table.rows == [["w", "merged", "twin_donkey", "quality loss", 4, 0.5, None, None]]
    assert "No conclusion: too few cells fail" in table.notes[0]
