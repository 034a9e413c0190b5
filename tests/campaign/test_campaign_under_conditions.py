# SPDX-License-Identifier: Apache-2.0
"""A campaign under conditions with real worker processes: its drives, gates and bags are the library's."""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path

import pytest
from tests.drives import driven

from ds_cli.campaign.run import stored_config
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.executor import trajectory_sha256
from ds_orchestrator.campaign.folder import ENGINE, CampaignData, open_store, read_campaign
from ds_orchestrator.campaign.status import roads_of
from ds_sim.conditions.text import format_conditions, parse_conditions
from ds_sim.gates.gate import GateState, gate_of
from ds_sim.registry import DONKEY
from ds_studies import whole_campaign as run

TEXT = "line_contrast=0.1,visibility=80,steering_lag=0.05"
CONFIG = parse_config(
    {
        "siblings": ["donkey"],
        "twin": "none",
        "driver": "autopilot",
        "engine": "local",
        "seed": 7,
        "search": {"population": 1, "iterations": 0, "runs": 1, "min_angle": 40, "max_angle": 90},
        "conditions": TEXT,
    },
    "test",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("campaign") / "out"
    with pytest.MonkeyPatch.context() as patch:
        # `test_report_browser.py` has a report of conditions.
        patch.setattr(run, "write_all", lambda folder, *_arguments, **_options: folder / "report.html")
        assert run.run_campaign(CONFIG, out).executions_in_error == 0
    return out


@pytest.fixture(scope="module")
def data(folder: Path) -> CampaignData:
    with closing(open_store(folder)) as store:
        return read_campaign(store)


def test_drives_and_gates_are_those_of_the_library(data: CampaignData) -> None:
    executions = {e.test_id: e for e in data.executions}
    assert data.tests
    for test in data.tests:
        assert test.conditions == parse_conditions(TEXT)
        alone = driven("donkey", test.road, test.seed, test.conditions, probed=True)
        assert data.gates[test.test_id, DONKEY] == gate_of(alone)
        if gate_of(alone).state is GateState.VALID:
            assert executions[test.test_id].trajectory_sha256 == trajectory_sha256(alone)
        else:
            assert test.test_id not in executions


def test_it_resumes_with_what_drove_it_last(folder: Path, tmp_path: Path) -> None:
    resumed = stored_config(folder, None)
    assert (resumed.engine, resumed.workers) == ("local", 1)
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    too_many, evil = '{"engine": "graph", "workers": 65}', '{"engine": "evil", "workers": 1}'
    for text in (too_many, evil, '{"engine": "graph"}', "[" * 900):
        (copy / ENGINE).write_text(text)
        found = stored_config(copy, None)
        assert (found.engine, found.workers) == ("auto", 1)  # the defaults
    (copy / ENGINE).write_text('{"engine": "dask", "workers": 3}')
    assert stored_config(copy, None) == resumed.model_copy(update={"engine": "dask", "workers": 3})


def test_roads_carry_their_conditions(folder: Path) -> None:
    assert {road["conditions"] for road in roads_of(folder)} == {format_conditions(parse_conditions(TEXT))}
