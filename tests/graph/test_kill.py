# SPDX-License-Identifier: Apache-2.0
"""Nothing is lost: processes are killed at seeded moments, and the resumed campaign equals an undisturbed one."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from benchmarks.kill import (
    EXECUTIONS,
    KINDS,
    WHOLE,
    Session,
    differences,
    disturbed,
    lines_of,
    marked,
    processes_left,
    stored,
)
from tests.command_line import document, ds_process

pytestmark = pytest.mark.graph

SEED = 2
ORDER = ("orchestrator", "driver", "sigint", "simulator", "worker", "two", "sigterm")
"""Process killed at each moment, in turn. The first is in every run of the tests, the others are marked `long`."""
PROCESSES = 3
"""Processes of a graph: three simulators, each with a driver."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "number" in metafunc.fixturenames:
        moments = range(metafunc.config.getoption("--moments"))
        metafunc.parametrize("number", [pytest.param(n, marks=[pytest.mark.long] * (n > 0)) for n in moments])


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[float], list[set[str]]]:
    """Two campaigns at the same time, one with one worker and one with two.

    Returns:
        Their folder; the seconds at which the first printed its lines; the ROS domains of each.
    """
    folder = tmp_path_factory.mktemp("kill")
    two = Session(folder / "two", 2)
    one = Session(folder / WHOLE, 1)
    domains: list[set[str]] = [set(), set()]

    def watch() -> None:
        while one.process.poll() is None or two.process.poll() is None:
            for seen, session in zip(domains, (one, two), strict=True):
                # A process that has only just been forked has no domain yet.
                others = {pid: domain for pid, domain in marked(session.folder).items() if pid != session.process.pid}
                seen.update(filter(None, others.values()))
            time.sleep(0.5)

    listener = threading.Thread(target=watch)
    listener.start()
    times = lines_of(one)
    assert two.wait() == 0
    listener.join()
    return folder, times, domains


def test_two_campaigns_and_any_number_of_workers_give_the_same_bytes(
    campaigns: tuple[Path, list[float], list[set[str]]],
) -> None:
    """Each worker has a separate ROS domain with the same names."""
    folder, _, (of_one, of_two) = campaigns
    assert len(stored(folder / WHOLE)) == EXECUTIONS
    assert differences(folder / "two", folder / WHOLE, {}) == []
    assert len(of_one) == 1 and len(of_two) == 2 and not of_one & of_two
    assert processes_left(folder / WHOLE) == processes_left(folder / "two") == 0
    logs = folder / "two" / "logs"
    assert len(list((logs / "worker_1").iterdir())) == len(list((logs / "worker_2").iterdir())) == PROCESSES


def test_a_killed_process_costs_the_runs_under_way_and_nothing_else(
    campaigns: tuple[Path, list[float], list[set[str]]], number: int
) -> None:
    folder, times, _ = campaigns
    assert set(ORDER) == set(KINDS)
    kind, workers = ORDER[number % len(ORDER)], 1 + (number % 5 == 4)
    rng = np.random.default_rng([SEED, number])
    report = disturbed(folder / f"moment_{number}", times, kind, workers, rng)
    assert report.problems == [], report
    assert report.killed


EVERYTHING = """
siblings: [bullet, softbody]
twin: donkey
driver: dave2
seed: 5
search: {population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 120}
"""


@pytest.mark.long
@pytest.mark.timeout(1200)  # the test loads both cores on purpose
def test_the_same_seed_gives_the_same_bytes_with_any_engine_also_on_a_busy_machine(tmp_path: Path) -> None:
    """All simulators with a network: two graphs, the second while other processes load both cores, then the others."""
    (tmp_path / "c.yaml").write_text(EVERYTHING)
    runs = {"graph": (), "busy": (), "local": ("--workers", "2"), "dask": ("--workers", "2")}
    for name, options in runs.items():
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (name == "busy"))]
        engine = "graph" if name == "busy" else name
        try:
            words = ("campaign", "run", tmp_path / "c.yaml", "--out", tmp_path / name, "--json", "--engine", engine)
            done = ds_process(*words, *options, timeout=400)
        finally:
            for process in busy:
                process.kill()
        assert done.returncode == 0, done.stderr[-2000:]
        result = json.loads(done.stdout)
        assert result["executions"] == 12 and result["executions_in_error"] == 0
        assert Path(result["report"]).is_file()
    first = tmp_path / "graph"
    assert len(stored(first)) == 12
    files = {path.relative_to(first) for part in ("maps/*.json", "bags/*/*") for path in first.glob(part)}
    assert {Path("maps/merged.json"), Path("maps/twin_donkey.json")} <= files and len(files) > 24
    for name in ("busy", "local", "dask"):
        assert stored(tmp_path / name) == stored(first), name
        for file in sorted(files):
            assert (tmp_path / name / file).read_bytes() == (first / file).read_bytes(), f"{name}: {file}"
    assert document("maps", first) == json.loads((first / "maps" / "maps.json").read_text())
