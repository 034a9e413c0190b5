# SPDX-License-Identifier: Apache-2.0
"""Kind of received file: a regression suite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tests.fuzz.damage import damaged_file
from tests.fuzz.harness import Kind

from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import ConfigError
from ds_road import generate
from ds_studies.suite.suite_file import Suite, read_suite, road_sha256, settings_of_suite, write_suite


def suite_of(count: int, *, driver: str = "dave2", twin: str = "donkey") -> dict[str, Any]:
    """A suite of so many tests, as its file has it."""
    outcome = {"outcome": "COMPLETED", "fitness": 0.5, "trajectory_sha256": "0" * 64}
    tests = []
    for number in range(count):
        points = [list(map(float, point)) for point in generate(np.random.default_rng(number)).control_points]
        tests.append(
            {
                "name": f"bullet-0-{number:04d}",
                "why": ["failing", "cell"],
                "control_points": points,
                "road_sha256": road_sha256(points),
                "seed": number,
                "conditions": "visibility=80" if number else "",
                "cell": [3, 17],
                "outcomes": {"bullet": outcome, twin: outcome},
            }
        )
    format_ = {"format": "digital-siblings-suite", "version": 1}
    return {**format_, "campaign": "mine", "driver": driver, "siblings": ["bullet"], "twin": twin, "tests": tests}


def _write(folder: Path, n: int) -> Path:
    write_suite(Suite.model_validate(suite_of(n)), folder / "suite.json")
    return folder / "suite.json"


def _read(path: Path) -> object:
    """Read a suite as `ds suite run` does before it drives."""
    suite = read_suite(path)
    return settings_of_suite(suite, AUTOPILOT), [suite.scenario_of(test).road.points for test in suite.tests]


KINDS = [Kind("suite", _write, damaged_file, _read, (ConfigError,), 20, small=2)]
