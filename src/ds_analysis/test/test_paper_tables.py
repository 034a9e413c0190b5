# SPDX-License-Identifier: Apache-2.0
"""The paper's tables, which read back and compile, and its RQ1 by densities, distance, test, effect and power."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_networks import write_recorded
from numpy.typing import NDArray
from progress_lines import ProgressLines
from rich.console import Console
from scipy.stats import nct, norm, t, wasserstein_distance, wilcoxon

from ds_analysis.paper.correlation import Correlation, PairedDifference, RobustnessCheck
from ds_analysis.paper.open_loop import OpenLoopError, predict
from ds_analysis.paper.paper_tables import (
    correlation_tables,
    error_tables,
    network_of,
    paired_difference_table,
    robustness_table,
    role_of,
)
from ds_analysis.paper.steering_error_stats import check_error_robustness, cohens_d, compare_errors, densities, shares
from ds_base.progress import SILENT
from ds_base.table import Column, Table, TableError, keep_tables, read_tables, shown
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_driver.networks.pilot import Frame
from ds_driver.networks.torch_networks import make_network, save_weights
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
    table = json.loads(path.read_text())[0]
    without_number: dict[str, object] = {"rows": [["z", float("nan"), None, 0.5, 3]]}
    damages: list[dict[str, object]] = [{"rows": [["x"]]}, without_number, {"title": None}]
    for broken in ("[", '[{"name": "t"}]', "3", *(json.dumps([table | damage]) for damage in damages)):
        path.write_text(broken)
        with pytest.raises(TableError, match=r"kept\.json cannot be read .*: remove it"):
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


RNG = np.random.default_rng(4)
ONE = np.abs(RNG.normal(0, 0.12, 400))
OTHER = np.abs(RNG.normal(0, 0.16, 300))
TWIN = np.abs(RNG.normal(0, 0.15, 500))
GREY = np.full((160, 320, 3), 100, np.uint8)


def counted(errors: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    return np.array([np.sum((errors >= 0.04 * k) & (errors < 0.04 * (k + 1))) for k in range(15)])


def test_densities_are_the_authors_and_shares_the_papers() -> None:
    errors = np.array([0.01, 0.02, 0.05, 0.59, 0.7])  # the last is beyond the range
    assert densities(errors)[[0, 1, 14]] == pytest.approx([2 / 4 / 0.04, 1 / 4 / 0.04, 1 / 4 / 0.04])
    assert shares(errors)[[0, 1, 14]] == pytest.approx([2 / 5, 1 / 5, 1 / 5])
    np.testing.assert_allclose(densities(ONE), counted(ONE) / counted(ONE).sum() / 0.04)
    assert densities(ONE).sum() * 0.04 == pytest.approx(1.0)


def test_distance_is_the_area_between_the_distribution_functions() -> None:
    """Paper 4.3.1: the integral of |CDF_A - CDF_B|, here of steps at the bins' right ends."""
    (row, _) = compare_errors({"a": ONE}, TWIN)
    one, twin = (counted(e) / counted(e).sum() for e in (ONE, TWIN))
    assert row.distance == pytest.approx(0.04 * np.abs(np.cumsum(one) - np.cumsum(twin))[:-1].sum())
    assert row.p == pytest.approx(wilcoxon(one, twin).pvalue)
    assert row.mean_squared == pytest.approx(np.mean(ONE**2)) and row.beyond == np.mean(ONE > 0.6)


def test_effect_and_power_are_the_textbooks() -> None:
    """Power of a t test by the non-central t distribution; the authors count both samples' errors for each sample."""
    (row, _) = compare_errors({"a": ONE}, TWIN)
    pooled = math.sqrt((399 * ONE.var(ddof=1) + 499 * TWIN.var(ddof=1)) / 898)
    effect = (ONE.mean() - TWIN.mean()) / pooled
    assert row.effect == pytest.approx(effect) == cohens_d(ONE, TWIN)

    def power(n: float, m: float) -> float:
        shift, freedom = effect / math.sqrt(1 / n + 1 / m), n + m - 2
        limit = t.ppf(0.975, freedom)
        return float(nct.sf(limit, freedom, shift) + nct.cdf(-limit, freedom, shift))

    assert row.power == pytest.approx(power(900, 900), abs=1e-6)
    (true,) = [v for v in check_error_robustness({"a": ONE}, TWIN) if "power" in v.what and v.name == "a"]
    assert true.power == pytest.approx(power(400, 500), abs=1e-6)
    # Sample size by the normal approximation: 2 ((z_0.975 + z_0.8) / d)^2.
    assert row.enough == pytest.approx(2 * ((norm.ppf(0.975) + norm.ppf(0.8)) / effect) ** 2, rel=0.02)


def test_equal_errors_have_no_test_and_no_effect() -> None:
    for row in compare_errors({"a": TWIN}, TWIN):
        assert (row.distance, row.p, row.power, row.enough, row.alike, row.effect) == (0.0, *[None] * 4, 0.0)
    constant = np.full(5, 0.1)
    assert compare_errors({"a": constant}, constant)[0].effect is None


def test_a_network_with_only_large_errors_is_refused() -> None:
    with pytest.raises(OpenLoopError, match=r"every error on one of the simulators is above 0\.6"):
        compare_errors({"a": np.full(9, 0.9)}, TWIN)


@pytest.mark.parametrize(
    ("siblings", "twin", "message"),
    [
        ({}, TWIN, "expected at least one sibling"),
        ({"a": TWIN[:0]}, TWIN, "no image of a has an error"),
        ({"a": TWIN}, TWIN[:0], "no image of the twin has an error"),
    ],
)
def test_a_comparison_needs_errors_of_a_sibling_and_of_the_twin(
    siblings: dict[str, NDArray[np.float64]], twin: NDArray[np.float64], message: str
) -> None:
    for compare in (compare_errors, check_error_robustness):
        with pytest.raises(OpenLoopError, match=message):
            compare(siblings, twin)


def test_predictions_over_a_data_set(tmp_path: Path) -> None:
    """A network whose only non-zero parameter is the last bias predicts that bias everywhere, beyond full lock."""
    network = make_network("chauffeur")
    with torch.no_grad():
        for value in network.parameters():
            value.zero_()
        list(network.parameters())[-1].fill_(1.25)
    save_weights(network, tmp_path / "biased.safetensors", architecture="chauffeur")
    for simulator, labels in (("bullet", [0.5, 1.0, 0.75]), ("donkey", [1.0, 0.9])):
        write_recorded(tmp_path / "data", simulator, [GREY] * len(labels), labels)
    told = ProgressLines()
    biased = DriverName(str(tmp_path / "biased.safetensors"))
    found = predict(tmp_path / "data", biased, told)
    assert found["bullet"].absolute_errors == pytest.approx([0.75, 0.25, 0.5], abs=1e-3)
    assert found["donkey"].recorded == pytest.approx([1.0, 0.9]) and (told.done, told.total) == (5, 5)
    few = predict(tmp_path / "data", biased, SILENT, images=2)
    assert few["bullet"].recorded == pytest.approx([0.5, 0.75])
    with pytest.raises(OpenLoopError, match="name a network"):
        predict(tmp_path / "data", AUTOPILOT, SILENT)


class Summing:
    """Answers the mean brightness of its drive so far, and its speed as throttle: it may not miss a frame."""

    def start(self) -> None:
        self.total = 0.0

    def drive(self, frame: Frame) -> float:
        self.total += frame.image.mean() / 25500 + frame.speed
        return self.total


def test_a_network_with_memory_is_shown_drives_in_order_and_none_with_gaps(tmp_path: Path) -> None:
    for folder, every in (("whole", 1), ("thin", 3)):
        for direction in ("forward", "reverse"):
            write_recorded(tmp_path / folder, "bullet", [GREY] * 3, [0.0] * 3, direction=direction, every=every)
    name = DriverName(f"{__name__}:Summing")
    each = 100 / 25500 + 0.1
    whole = predict(tmp_path / "whole", name, SILENT)["bullet"]
    assert whole.answered == pytest.approx([each, 2 * each, 3 * each] * 2, abs=1e-3)
    few = predict(tmp_path / "whole", name, SILENT, images=4)["bullet"]
    assert few.answered == pytest.approx([each, 2 * each, 3 * each, each], abs=1e-3)
    with pytest.raises(OpenLoopError, match="leaves out frames of bullet, and .* remembers .*: collect with --every 1"):
        predict(tmp_path / "thin", name, SILENT)


def test_a_network_has_an_architecture_whatever_its_name(tmp_path: Path) -> None:
    save_weights(make_network("chauffeur"), tmp_path / "mine.safetensors", architecture="chauffeur")
    assert network_of(DriverName.parse(str(tmp_path / "mine.safetensors"))) == ("chauffeur", "sim")
    for name in ("dave2", "dave2_short", "dave2_short@onnx"):
        assert network_of(DriverName.parse(name)) == ("dave2", "sim")
    for name in ("autopilot", "missing.safetensors", "my_driver:Driver"):
        assert network_of(DriverName.parse(name)) is None


def test_the_table_stands_beside_the_papers() -> None:
    groups = {"bullet": ONE, "softbody": OTHER}
    rows, others = compare_errors(groups, TWIN), check_error_robustness(groups, TWIN)
    errors = {**groups, "donkey": TWIN}
    main, _, bins = error_tables(rows, others, errors, ["bullet", "softbody"], "donkey", ("dave2", "sim"))
    by_name = {c.name: k for k, c in enumerate(main.columns)}
    assert [row[by_name["paper: distance"]] for row in main.rows] == [0.04669, 0.02648, 0.03776]
    assert [row[0] for row in main.rows] == ["DS1", "DS2", "DSS"]
    assert "(paper: 0.08)" in main.notes[0] and len(bins.rows) == 15
    plain = error_tables(rows, others, errors, ["bullet", "softbody"], "donkey", None)[0]
    assert not any(c.name.startswith("paper") for c in plain.columns)


def test_other_ways_use_the_errors_themselves() -> None:
    (raw,) = [v for v in check_error_robustness({"a": ONE}, TWIN) if "no bins" in v.what and v.name == "a"]
    assert raw.distance == pytest.approx(wasserstein_distance(ONE, TWIN)) and raw.p is not None
