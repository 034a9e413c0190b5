# SPDX-License-Identifier: Apache-2.0
"""The action at the root: its step that tests a network runs here, as a script in an empty folder, on real drives."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import cv2
import yaml
from junitparser import JUnitXml

ROOT = Path(__file__).resolve().parents[1]
CAMPAIGN = """\
driver: dave2  # is replaced
siblings: [softbody]
twin: none
search: {population: 1, iterations: 0, runs: 1}
record: none
"""
STRAIGHT_ON = "class Driver:\n    def drive(self, frame):\n        return 0.0, 0.5\n"


def action() -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load((ROOT / "action.yml").read_text())
    return document


def step(name: str) -> dict[str, Any]:
    (found,) = (one for one in action()["runs"]["steps"] if one.get("name") == name)
    return dict(found)


def run_step(folder: Path, **inputs: str) -> subprocess.CompletedProcess[str]:
    """Run the step `Test` with the inputs' defaults, as a runner fills its environment."""
    values = {name: about.get("default", "") for name, about in action()["inputs"].items()} | inputs
    env = {"github.action_path": str(ROOT), **{f"inputs.{name}": value for name, value in values.items()}}
    filled = {key: env[text.strip("${} ")] for key, text in step("Test")["env"].items()}
    outer = {"DS": str(ROOT / "ds"), "RUNNER_TEMP": str(folder), "GITHUB_STEP_SUMMARY": str(folder / "page.md")}
    command = ["bash", "-eo", "pipefail", "-c", step("Test")["run"]]
    variables = os.environ | outer | filled
    return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, timeout=300)


def test_a_failing_network_fails_the_step_which_keeps_a_video_and_a_summary(tmp_path: Path) -> None:
    (tmp_path / "campaign.yaml").write_text(CAMPAIGN)
    (tmp_path / "straight_on.py").write_text(STRAIGHT_ON)
    done = run_step(tmp_path, network="straight_on:Driver", tests="campaign.yaml")
    assert done.returncode == 3, done.stderr
    results = tmp_path / step("Keep the results")["with"]["path"].replace("${{ inputs.results }}", "digital-siblings")
    (suite,) = JUnitXml.fromfile(str(results / "junit.xml"))
    assert (suite.name, suite.tests, suite.failures) == ("softbody", 1, 1)
    (video,) = (results / "videos").glob("*.mp4")
    assert cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FRAME_COUNT) > 20
    assert (tmp_path / "page.md").read_text() == (results / "summary.md").read_text() != ""
    inputs = {"network": "straight_on:Driver", "tests": "campaign.yaml", "options": "--max-failures 100%"}
    relaxed = run_step(tmp_path, **inputs, results="again", **{"fail-on": "failure"})
    assert relaxed.returncode == 3
    assert (tmp_path / "again" / "junit.xml").read_bytes() == (results / "junit.xml").read_bytes()
