# SPDX-License-Identifier: Apache-2.0
"""Campaigns whose search varies conditions; made-up drives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.campaign.test_campaign import CONFIG, maps_text, run
from tests.campaign.test_gates import GatedEngine

from ds_analysis.paper.campaign_contents import maps_of
from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.campaign.folder import read_campaign

SEARCHED = {"line_contrast": {"low": 0.1, "high": 0.9}, "visibility": {"low": 20.0, "high": 200.0, "step": 0.5}}


def config_of(population: int, iterations: int, **more: Any) -> CampaignConfig:
    """The campaign with another search, of these conditions, and the features that it then has."""
    raw = json.loads(CONFIG.identity())
    del raw["features"]
    raw["search"] |= {"conditions": SEARCHED, "population": population, "iterations": iterations}
    return parse_config({**raw, "engine": "local", **more}, "here")


def test_a_stopped_search_of_conditions_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    config = config_of(3, 4)
    assert config.features == ["lane_curvature", "line_contrast"]
    executor = GatedEngine()
    _, undisturbed = run(tmp_path / "whole", executor, config)
    first, second = GatedEngine(runs=5), GatedEngine()
    run(tmp_path / "parts", first, config)[1].close()
    _, store = run(tmp_path / "parts", second, config)
    assert maps_text(store) == maps_text(undisturbed)
    assert sorted(first.roads + second.roads) == sorted(executor.roads)
    data = read_campaign(store)
    conditions = [test.conditions for test in data.tests]
    assert len(set(conditions)) > len(conditions) / 2
    assert all(0.1 <= one.line_contrast <= 0.9 and 20.0 <= one.visibility <= 200.0 for one in conditions)
    cells = {cell for feature_map in maps_of(data).values() for cell in feature_map.cells}
    assert {cell[1] for cell in cells} <= set(range(1, 10)) and len({cell[1] for cell in cells}) > 1
    # Each test is driven on each simulator at which it is valid, whatever the order.
    assert {(e.test_id, e.simulator) for e in data.executions} == {k for k, gate in data.gates.items() if gate.is_valid}
    assert len(data.gates) == len(data.tests) * len(config.simulators)


def test_maps_of_the_usual_conditions_are_drawn_beside_those_of_the_paper() -> None:
    searched = {**SEARCHED, "veiling_luminance": {"low": 0.0, "high": 3000.0}}
    config = parse_config({"search": {"conditions": searched}}, "here")
    assert config.features == ["lane_curvature", "line_contrast"]
    assert config.further_axes == [
        ("lane_curvature", "visibility"),
        ("lane_curvature", "veiling_luminance"),
        ("turns_count", "curvature"),
    ]
    of_paper = parse_config({"search": {"conditions": SEARCHED}, "features": ["turns_count", "curvature"]}, "here")
    assert of_paper.further_axes == [("lane_curvature", "line_contrast"), ("lane_curvature", "visibility")]
    assert parse_config({}, "here").further_axes == []


def test_a_search_by_measured_contrast_fills_its_cells(tmp_path: Path) -> None:
    config = config_of(3, 2, features=["turns_count", "visible_contrast"])
    data = read_campaign(run(tmp_path, GatedEngine(), config)[1])
    own = {test.test_id: data.gates[test.test_id, test.sibling].visible_contrast for test in data.tests}
    driven = {(e.test_id, e.simulator) for e in data.executions}
    by_own = {test.test_id for test in data.tests if (test.test_id, test.sibling) in driven}
    cells = {i: cell[1] for i, cell in data.cells.items() if i in by_own}
    assert cells and all(0.05 * 2**bin_ <= own[i] < 0.05 * 2 ** (bin_ + 1) for i, bin_ in cells.items())


def test_a_search_without_conditions_has_the_text_of_earlier_versions() -> None:
    keys = "method population iterations runs min_angle max_angle extent"
    assert set(json.loads(CONFIG.identity())["search"]) == set(keys.split())
