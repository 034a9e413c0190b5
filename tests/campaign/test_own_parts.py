# SPDX-License-Identifier: Apache-2.0
"""A user's own search, features and merge operators, as `module:NAME`; no received file decides that they run."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.campaign.own_parts import StraightSearch
from tests.campaign.test_campaign import CONFIG, OWN, run
from tests.campaign.test_gates import GatedEngine

from ds_analysis.paper.campaign_contents import maps_of
from ds_base.extension import installed
from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.campaign.folder import read_campaign
from ds_orchestrator.maps.algebra import operator_of
from ds_orchestrator.maps.feature_map import MapId
from ds_orchestrator.search.algorithms import search_of


def config_of(**changes: Any) -> CampaignConfig:
    raw = {
        "siblings": CONFIG.siblings,
        "twin": CONFIG.twin,
        "driver": "autopilot",
        "engine": "local",
        "record": "none",
        "search": {"population": 2, "iterations": 3, "runs": 1, "method": f"{OWN}:StraightSearch"},
        "features": ["turns_count", f"{OWN}:EASTING:5"],
        "operators": {"probability": f"{OWN}:MEDIAN"},
    }
    return parse_config({**raw, **changes}, "mine.yaml")


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An installed package that adds the feature `easting` and the operator `median`."""
    about = tmp_path / "installed" / "own_parts-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: own-parts\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        f"[digital_siblings.features]\neasting = {OWN}:EASTING\n[digital_siblings.operators]\nmedian = {OWN}:MEDIAN\n"
    )
    monkeypatch.syspath_prepend(about.parent)
    installed.cache_clear()
    yield
    installed.cache_clear()


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(("feature", "median"), [(f"{OWN}:EASTING:5", f"{OWN}:MEDIAN"), ("easting:5", "median")])
def test_a_campaign_runs_with_parts_of_the_users_own(tmp_path: Path, feature: str, median: str) -> None:
    config = config_of(features=["turns_count", feature], operators={"probability": median})
    data = read_campaign(run(tmp_path / "campaign", GatedEngine(), config)[1])
    assert search_of(f"{OWN}:StraightSearch") is StraightSearch
    assert all(test.road.curvature < 0.08 for test in data.tests), "drawn by the own search"
    expected = {test.test_id: (test.road.turns_count, int(test.road.control_points[-1][0]) // 5) for test in data.tests}
    assert data.cells == expected
    merged = maps_of(data)[MapId.merged()]
    values = np.array([[0.0, 0.5], [1.0, 0.5]])
    assert operator_of(median).combine(values, np.ones(2)).tolist() == [0.5, 0.5]
    assert merged.cells and set(merged.cells) <= set(expected.values())


@pytest.mark.parametrize(("allowed", "status"), [("", 2), (f"{OWN}:MEDIAN,{OWN}:EASTING,{OWN}:StraightSearch", 0)])
def test_a_received_folder_runs_no_code_that_the_user_has_not_named(tmp_path: Path, allowed: str, status: int) -> None:
    run(tmp_path, GatedEngine(), config_of())[1].close()
    script = f"import sys; from ds_cli.application import run; code = run(['campaign', 'status', {str(tmp_path)!r}])\n"
    script += f"print('imported' if {OWN!r} in sys.modules else 'not imported'); sys.exit(code)"
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        timeout=120,
        env={"DS_TRUST": allowed, "PYTHONPATH": ":".join(map(str, sys.path)), "PATH": "/usr/bin:/bin"},
    )
    assert done.returncode == status, done.stderr
    assert ("not imported" in done.stdout) == (not allowed)
    if not allowed:
        assert "a received file must not run code" in done.stderr and done.stderr.count("\n") == 1
