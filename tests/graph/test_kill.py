"""Nothing lost: processes are killed at seeded moments, the campaign goes on, and ends as if nothing had been."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.kill import EXECUTIONS, KINDS, WHOLE, disturbed, stored, undisturbed

pytestmark = pytest.mark.graph

SEED = 2
ORDER = ("orchestrator", "driver", "sigint", "simulator", "worker", "two", "sigterm")
"""The first ones are in every run of the tests, `--moments` asks for more."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "number" in metafunc.fixturenames:
        metafunc.parametrize("number", range(metafunc.config.getoption("--moments")))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[float]]:
    """The folder with the campaign that nothing disturbed, and the seconds at which its lines came."""
    folder = tmp_path_factory.mktemp("kill")
    times = undisturbed(folder / WHOLE)
    assert len(stored(folder / WHOLE)) == EXECUTIONS and set(ORDER) == set(KINDS)
    return folder, times


def test_a_killed_process_costs_the_runs_under_way_and_nothing_else(
    whole: tuple[Path, list[float]], number: int
) -> None:
    folder, times = whole
    kind = ORDER[number % len(ORDER)]
    report = disturbed(folder / f"moment_{number}", times, kind, np.random.default_rng([SEED, number]))
    assert report.problems == [], report
    assert report.killed
