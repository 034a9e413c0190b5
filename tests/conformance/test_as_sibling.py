# SPDX-License-Identifier: Apache-2.0
"""The example of docs/add_a_simulator.md as a third sibling, with the line that the document shows."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml
from tests.command_line import ds_process

from ds_orchestrator.campaign.config import parse_config

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "add_a_simulator.md"


def documented_line() -> str:
    line = re.search(r"^siblings: .*$", DOCUMENT.read_text(), re.MULTILINE)
    assert line is not None
    return line.group()


def test_the_documented_line_is_a_configuration() -> None:
    config = parse_config(yaml.safe_load(documented_line()), "add_a_simulator.md")
    assert config.siblings == ["bullet", "softbody", "bicycle:BicycleSimulator"]


@pytest.mark.graph
@pytest.mark.long
def test_the_whole_method_takes_a_third_sibling(tmp_path: Path) -> None:
    search = "search: {population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 90}"
    (tmp_path / "c.yaml").write_text("\n".join((documented_line(), "twin: donkey", "driver: autopilot", search)))
    done = ds_process("campaign", "run", "c.yaml", "--out", "out", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    document = json.loads(done.stdout)
    # Two tests from each of three searches, each on three siblings and on the twin.
    assert document["executions"] == 3 * 2 * 4 and document["executions_in_error"] == 0
    maps = json.loads((tmp_path / "out" / "maps" / "maps.json").read_text())
    unions = [maps[f"union_{name}"] for name in ("bullet", "softbody", "bicycle:BicycleSimulator")]
    assert all(sum(cell["tests"] for cell in union["cells"]) == 6 for union in unions)
    assert len(list((tmp_path / "out" / "maps").glob("union_bicycle.BicycleSimulator-????????.json"))) == 1
    assert "bicycle" in (tmp_path / "out" / "report.html").read_text()
