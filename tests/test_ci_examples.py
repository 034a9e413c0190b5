# SPDX-License-Identifier: Apache-2.0
"""The example workflows for CI: their steps run as a script, with a `ds` that answers without driving."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from ds_cli.application import make_app

ROOT = Path(__file__).resolve().parents[1]
CI = ROOT / "examples/ci"
DS = """\
#!/usr/bin/env bash
# Notes its arguments, writes what `ds suite run` writes, and exits with $ANSWER.
printf '%s\\n' "$*" >>calls
while (($#)); do
  case $1 in --junit | --markdown) echo "$1" >"$2" ;; esac
  shift
done
exit "${ANSWER:-0}"
"""


def script_of(name: str) -> tuple[str, dict[str, str]]:
    """Commands that check the network, without those that install, and the variables of the job."""
    workflow: dict[str, Any] = yaml.safe_load((CI / f"{name}.yml").read_text())
    if name == "gitlab":
        return "\n".join(workflow["check_network"]["script"]), workflow["check_network"]["variables"]
    (step,) = (step for step in workflow["jobs"]["suite"]["steps"] if step.get("name") == "Drive the suite")
    return step["run"], workflow["env"]


@pytest.mark.parametrize("name", ["github_actions", "gitlab"])
@pytest.mark.parametrize("answer", [0, 1, 3])
def test_the_steps_run_and_end_with_the_status_of_the_suite(tmp_path: Path, name: str, answer: int) -> None:
    checkout = tmp_path / "digital-siblings"
    (checkout / "examples").mkdir(parents=True)
    (checkout / "examples/ci").symlink_to(CI)
    (checkout / "ds").write_text(DS)
    (checkout / "ds").chmod(0o755)
    script, variables = script_of(name)
    summary = tmp_path / "step_summary.md"
    env = {**os.environ, **variables, "ANSWER": str(answer), "GITHUB_STEP_SUMMARY": str(summary)}
    command = ["bash", "-euo", "pipefail", "-c", script]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60)
    assert done.returncode == answer, done.stderr
    call = (tmp_path / "calls").read_text()
    assert call.startswith("suite run suite.json --driver network/my_net.yaml --out results/suite --fail-on regression")
    assert summary.read_text() == (tmp_path / "results/summary.md").read_text()


def test_the_options_of_the_script_are_options_of_the_verb() -> None:
    words = (CI / "check_network.sh").read_text().split()
    application: Any = make_app()
    suite = application.get_command(None, "suite")
    known = {option for parameter in suite.commands["run"].params for option in parameter.opts}
    used = {word for word in words if word.startswith("--")} - {"--driver`", "--"}
    assert used and used <= known
