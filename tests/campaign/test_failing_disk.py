# SPDX-License-Identifier: Apache-2.0
"""The disk fails at each call in turn, or loses its power: nothing is left over, and the same command goes on."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.campaign.disk import KINDS, Disk, damage, differences, needs_compiler
from tests.campaign.failing_disk import CONFIG

SAMPLE, CUTS = 12, 199
"""Of so many calls, one fails, or is the last before a power cut, in every run of the tests; each one in long ones."""
FAILURES = [("full", "once"), ("full", "stays"), ("broken", "once"), ("broken", "stays"), ("short", "once")]
LONG = pytest.mark.long


@pytest.fixture
def scratch(tmp_path: Path) -> Iterator[Path]:
    """Folder in memory where there is some, as real disks take time to synchronise."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else tmp_path) as folder:
        yield Path(folder)


def lines_of(module: str, scratch: Path, *arguments: str | int) -> list[str]:
    """What a module that tries many failures prints but for its last line, which says how many it tried."""
    done = subprocess.run(
        [sys.executable, "-m", f"tests.campaign.{module}", str(scratch), *map(str, arguments)],
        env=Disk(scratch).environment,
        capture_output=True,
        text=True,
        check=False,
    )
    *wrong, last = done.stdout.splitlines() or [done.stderr]
    assert last.startswith("tried "), done.stdout + done.stderr
    return wrong


@needs_compiler
@pytest.mark.parametrize(
    ("error", "how", "first", "step"),
    [("full", "once", 5, SAMPLE), *(pytest.param(*one, 1, 1, marks=LONG) for one in FAILURES)],
)
def test_a_disk_that_fails_at_any_call_costs_nothing_but_time(
    error: str, how: str, first: int, step: int, scratch: Path
) -> None:
    assert lines_of("failing_disk", scratch, error, how, first, step) == []


@needs_compiler
@pytest.mark.parametrize(("first", "step"), [(60, CUTS), pytest.param(1, 1, marks=LONG)])
def test_a_power_cut_costs_at_most_the_last_drives(first: int, step: int, scratch: Path) -> None:
    assert lines_of("power_cut", scratch, first, step) == []


@needs_compiler
@pytest.mark.parametrize(
    ("engine", "each"),
    [pytest.param("local", 5, marks=LONG), pytest.param("graph", 3, marks=LONG), pytest.param("dask", 3, marks=LONG)],
)
@pytest.mark.timeout(1800)
def test_every_engine_survives_a_disk_that_fails(engine: str, each: int, scratch: Path) -> None:
    """Failures are spread over the calls of each kind in all processes, logs included; the report is whole."""
    disk = Disk(scratch)
    whole, tried = scratch / "whole", scratch / "tried"
    (scratch / "c.yaml").write_text(CONFIG.replace("[donkey]", "[donkey, softbody]"))

    def ds(folder: Path) -> tuple[int, str]:
        command = [sys.executable, "-m", "ds_cli.main", "campaign", "run", f"{scratch}/c.yaml", "--out", str(folder)]
        options = ["--engine", engine, "--workers", "2"]
        done = subprocess.run([*command, *options], env=disk.environment, capture_output=True, text=True, check=False)
        return done.returncode, done.stderr

    disk.arm(whole)
    status, said = ds(whole)
    assert status == 0, said
    wrong = []
    for kind, calls in enumerate(disk.disarm()):
        for nth in range(max(1, calls // each // 2), calls + 1, max(1, calls // each)):
            shutil.rmtree(tried, ignore_errors=True)
            disk.arm(tried, kind, nth, "full", stays=nth % 2 == 1)
            status, said = ds(tried)
            disk.disarm()
            problems = [] if status in (0, 1, 2) and "Traceback" not in said else [f"status {status}", said]
            if status:
                problems += damage(tried) if tried.is_dir() else []
                status, said = ds(tried)
                problems += [f"resumed: {status} {said}"] if status else []
            problems += differences(tried, whole)
            wrong += [f"{KINDS[kind]} {nth}: {problems}"] if problems else []
    assert wrong == []
