# SPDX-License-Identifier: Apache-2.0
"""Verbs on campaigns of thousands of executions: what they hold in memory does not grow with the campaign."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from report_campaigns import make_campaign

from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig
from ds_sim.registry import BULLET, DONKEY, SOFTBODY

BUDGET = 100
_INSIDE = """
import sys
from ds_cli.main import main
from ds_sim import SimulatorName
try:
    main()
finally:
    print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")), file=sys.stderr)
"""
"""Runs `ds`; its last line tells the most memory that the process held, kB, that of its parent left out."""


def large_campaign(folder: Path, runs: int) -> Path:
    """Create a finished campaign whose executions are copies of a few."""
    folder.mkdir()
    search = SearchConfig(population=BUDGET, iterations=0, runs=runs)
    config = CampaignConfig(siblings=[BULLET, SOFTBODY], twin=DONKEY, driver=AUTOPILOT, search=search)
    make_campaign(folder, config, 1).close()
    count = f"WITH n(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM n WHERE n < {runs * BUDGET - 1}) "
    test_id = f"printf('%s-%d-%04d', sibling, n / {BUDGET}, n % {BUDGET})"
    with closing(sqlite3.connect(folder / "campaign.sqlite")) as db, db:
        db.execute(
            f"INSERT INTO executions {count} SELECT {test_id}, simulator, outcome, message, fitness, "
            "max_lateral_position, steps, simulated_seconds, trajectory_sha256, bag, trajectory, steering "
            "FROM n, executions JOIN tests USING (test_id)"
        )
        db.execute(
            f"INSERT INTO tests {count} SELECT {test_id}, sibling, n / {BUDGET}, n % {BUDGET}, road, road_id, "
            "turns_count, curvature, seed, conditions FROM n, tests"
        )
    return folder


def memory(*arguments: str | Path) -> float:
    """Run `ds`, and return the most memory that it held, MB."""
    command = [sys.executable, "-c", _INSIDE, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    return int(done.stderr.split()[-2]) / 1024


@pytest.mark.parametrize(("verb", "most"), [(("campaign", "status"), 8.0), (("maps",), 60.0)])
def test_memory_of_a_verb_on_20_000_executions(tmp_path: Path, verb: tuple[str, ...], most: float) -> None:
    few, many = large_campaign(tmp_path / "few", 1), large_campaign(tmp_path / "many", 34)
    assert memory(*verb, many, "--json") - memory(*verb, few, "--json") < most
