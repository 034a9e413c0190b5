# SPDX-License-Identifier: Apache-2.0
"""The disk fails at each call in turn: the store stays sound, nothing is left over, and the same command resumes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CONFIG = """
siblings: [donkey]
twin: null
driver: autopilot
seed: 7
record: telemetry
search: {population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 90}
"""
SAMPLE = 24
"""Of so many calls, one fails in every run of the tests; all of them do in the ones that are marked `long`."""
FAILURES = [("full", "once"), ("full", "stays"), ("broken", "once"), ("broken", "stays"), ("short", "once")]


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize(
    ("error", "how", "first", "step"),
    [("full", "once", 5, SAMPLE), *(pytest.param(*one, 1, 1, marks=pytest.mark.long) for one in FAILURES)],
)
def test_a_disk_that_fails_at_any_call_costs_nothing_but_time(
    error: str, how: str, first: int, step: int, tmp_path: Path
) -> None:
    library = tmp_path / "disk.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, HERE / "failing_disk.c", "-ldl"], check=True)
    (tmp_path / "c.yaml").write_text(CONFIG)
    path = os.pathsep.join([str(HERE.parent.parent), os.environ.get("PYTHONPATH", "")])
    arguments = [str(tmp_path), str(library), error, how, str(first), str(step)]
    done = subprocess.run(
        [sys.executable, "-m", "tests.campaign.failing_disk", *arguments],
        env=os.environ | {"LD_PRELOAD": str(library), "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    *wrong, last = done.stdout.splitlines() or [done.stderr]
    assert last.startswith("tried "), done.stdout + done.stderr
    assert wrong == []
