# SPDX-License-Identifier: Apache-2.0
"""A campaign whose driver crashes: it continues with a restarted one, and reports the error."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from tests.graph.processes import simulator_processes

from ds_cli.campaign.inspection import campaign_status_command
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.graph import session as running
from ds_orchestrator.graph.supervisor import ProcessSpec
from ds_sim.registry import SimulatorName
from ds_studies.whole_campaign import run_campaign

pytestmark = pytest.mark.graph

LIMIT = 2.0
CONFIG = {
    "siblings": ["donkey"],
    "twin": None,
    "driver": "autopilot",  # in its place the faulty one
    "command_timeout": LIMIT,
    "retries": 1,
    "search": {"population": 2, "iterations": 1, "runs": 1, "min_angle": 40, "max_angle": 90},
}


def test_a_campaign_outlives_its_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver crashes once, during a run; the test is repeated, and the error enters no map."""
    faulty = ProcessSpec(
        name="driver",
        module="tests.graph.faulty_driver",
        namespace="/ds1",
        parameters={"fault": "crash", "once": str(tmp_path / "once")},
    )

    def separate(_driver: str, namespaces: dict[SimulatorName, str], limit: float, *, draw: str) -> list[ProcessSpec]:
        assert draw == "seen"
        return [*simulator_processes(namespaces, limit), faulty]

    monkeypatch.setattr(running, "closed_loop_processes", separate)
    began = time.monotonic()
    result = run_campaign(parse_config(CONFIG, "test"), tmp_path / "out")
    assert time.monotonic() - began < 100.0
    assert (tmp_path / "once").exists()
    assert result.executions == 3 and result.executions_in_error == 0
    errors = campaign_status_command(tmp_path / "out").document["errors"]
    assert [(error["outcome"], error["attempt"]) for error in errors] == [("SIM_ERROR", 0)]
    assert "driver ended during the run" in errors[0]["message"]
    report = result.report.read_text()
    assert errors[0]["test_id"] in report and "driver ended during the run" in report
