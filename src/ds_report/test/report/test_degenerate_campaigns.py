# SPDX-License-Identifier: Apache-2.0
"""Maps, evaluation and report of campaigns with almost no data."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_campaigns import make_execution, road

from ds_analysis.paper.paper_tables import read_correlations
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.maps.feature_map import MapId, map_ids
from ds_orchestrator.store.model import Origin, Test
from ds_orchestrator.store.store import Store
from ds_report.build import write_all
from ds_sim.registry import SimulatorName, label_of
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

TWO = CampaignConfig(
    siblings=[SimulatorName("nowhere:A"), SimulatorName("path_to_x:Sim")], twin=SimulatorName("nowhere:Twin")
)
"""Simulators that cannot be created, so that nothing is rendered; one has a name that looks like a migration."""
ONE, ALONE = (TWO.model_copy(update=changed) for changed in ({"siblings": TWO.siblings[:1]}, {"twin": None}))
FAILS, PASSES = 2.5, 0.5


def campaign(folder: Path, config: CampaignConfig, offsets: list[float], roads: list[int]) -> Store:
    """Create a store with one test per road, the siblings in turn, each with the same outcome on every simulator."""
    store = Store(folder / "campaign.sqlite", config=config.identity())
    for k, (offset, seed) in enumerate(zip(offsets, roads, strict=True)):
        sibling = config.siblings[k % len(config.siblings)]
        test = Test(f"t-0-{k:04d}", Scenario(road(seed), seed=1), Origin(sibling, 0, k))
        store.add_test(test)
        for name in config.simulators:
            store.add_execution(make_execution(test, name, offset))
    return store


def no_constant(name: str) -> Any:
    raise AssertionError(f"{name} in a JSON file")


@pytest.mark.parametrize(
    ("config", "offsets", "roads", "said"),
    [
        pytest.param(TWO, [PASSES], [0], "did not fail on the only road", id="one test"),
        pytest.param(TWO, [FAILS], [0], "failed on the only road", id="one failure"),
        pytest.param(TWO, [FAILS, PASSES], [0, 1], "failed on 1 of 2 roads", id="two tests"),
        pytest.param(TWO, [PASSES] * 6, list(range(6)), "failed on none of 6 roads", id="no failures"),
        pytest.param(TWO, [FAILS] * 6, list(range(6)), "failed on all 6 roads", id="all failures"),
        pytest.param(TWO, [FAILS, PASSES] * 2, [0] * 4, "failed on the only road", id="one road"),
        pytest.param(ONE, [FAILS, PASSES, PASSES], [0, 1, 2], "failed on 1 of 3 roads", id="one sibling"),
        pytest.param(ALONE, [FAILS, PASSES, PASSES], [0, 1, 2], "failed on 1 of 3 roads", id="no twin"),
        pytest.param(TWO, [], [], "Nothing was driven yet", id="nothing"),
    ],
)
def test_the_whole_chain(
    tmp_path: Path, config: CampaignConfig, offsets: list[float], roads: list[int], said: str
) -> None:
    store = campaign(tmp_path, config, offsets, roads)
    store.add_error("t-0-0000", config.siblings[0], 0, Outcome.SIM_ERROR, "broke")
    page = write_all(tmp_path, store).read_text(encoding="utf-8")
    assert said in page
    for path in (tmp_path / "maps").glob("*.json"):
        json.loads(path.read_text(), parse_constant=no_constant)
    for map_id in map_ids(config.siblings, config.twin):
        stem = tmp_path / "maps" / label_of(map_id.name)
        assert all(Path(f"{stem}{end}").is_file() for end in (".json", "_probability.png", "_quality.png"))
    tables = list((tmp_path / "evaluation").glob("*.csv"))
    assert any(not path.stem.startswith("sibling_") for path in tables) == bool(config.twin)
    assert any(path.stem.startswith("sibling_") for path in tables) == bool(offsets)
    assert ("What does a sibling add?" in page) == bool(offsets) == ("too few failures to say" in page)
    for path in tables:
        assert not {"nan", "inf", "-inf"} & {value for row in csv.reader(path.open()) for value in row}
    found = read_correlations(tmp_path, config)
    compared = 2 * (len(config.siblings) + 1)
    assert len(found) == (compared if config.twin else 0)
    # With so few cells r allows no conclusion, and no interval is given.
    assert all(c.caution and c.r_interval is None and c.auc_interval is None for c in found)
    assert ("No conclusion from this campaign" in page) == bool(config.twin)
    # Write again: the results are up to date, and rewriting them loses nothing.
    assert write_all(tmp_path, store).read_text(encoding="utf-8") == page
    store.close()


def test_a_report_says_what_each_sibling_adds(tmp_path: Path) -> None:
    """The same outcomes everywhere, on roads that do not decide them: the second sibling says no more."""
    fails = np.random.default_rng(3).permutation(24) < 12
    store = campaign(tmp_path, TWO, [FAILS if one else PASSES for one in fails], list(range(24)))
    page = write_all(tmp_path, store).read_text(encoding="utf-8")
    store.close()
    adds = r"<li>nowhere:A adds 0\.\d+ bits \(.*\) about nowhere:Twin beyond features: adds information</li>"
    assert re.search(adds, page)
    assert re.search(r"<li>path_to_x:Sim adds .* beyond features and nowhere:A: nothing shown</li>", page)
    assert page.count('<img class="wide" src="data:image/png;base64,') == 2
    rows = list(csv.DictReader((tmp_path / "evaluation" / "sibling_information.csv").open()))
    assert [row["verdict"] for row in rows] == ["adds information", "nothing shown"]


def test_correlations_of_an_earlier_version_are_read(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    of_r = {"cells": 9, "r": 0.5, "p": 0.1, "reason": "", "r_interval": [0.1, 0.9]}
    of_auc = {"baseline": 0, "auc": None, "auc_interval": None, "auc_reason": "why"}
    row = {"name": "union_path_to_x:Sim", "value": "quality", **of_r, **of_auc}
    (tmp_path / "maps" / "correlations.json").write_text(json.dumps([row]))
    (found,) = read_correlations(tmp_path, TWO)
    assert found.map == MapId.union(SimulatorName("path_to_x:Sim")) and found.value == "quality_loss"
    assert found.r_interval == (0.1, 0.9) and found.failing is None and found.caution == ""
