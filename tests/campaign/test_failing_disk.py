# SPDX-License-Identifier: Apache-2.0
"""The disk fails at each call in turn: the store stays sound, nothing is left over, and the same command resumes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from tests.campaign.disk import Disk, needs_compiler

SAMPLE = 24
"""Of so many calls, one fails in every run of the tests; all of them do in the ones that are marked `long`."""
FAILURES = [("full", "once"), ("full", "stays"), ("broken", "once"), ("broken", "stays"), ("short", "once")]


@needs_compiler
@pytest.mark.parametrize(
    ("error", "how", "first", "step"),
    [("full", "once", 5, SAMPLE), *(pytest.param(*one, 1, 1, marks=pytest.mark.long) for one in FAILURES)],
)
def test_a_disk_that_fails_at_any_call_costs_nothing_but_time(
    error: str, how: str, first: int, step: int, tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.campaign.failing_disk", str(tmp_path), error, how, str(first), str(step)],
        env=Disk(tmp_path).environment,
        capture_output=True,
        text=True,
        check=False,
    )
    *wrong, last = done.stdout.splitlines() or [done.stderr]
    assert last.startswith("tried "), done.stdout + done.stderr
    assert wrong == []
