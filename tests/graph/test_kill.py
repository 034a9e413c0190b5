# SPDX-License-Identifier: Apache-2.0
"""Nothing is lost: processes are killed at seeded moments, and the resumed campaign equals an undisturbed one."""

from __future__ import annotations

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
