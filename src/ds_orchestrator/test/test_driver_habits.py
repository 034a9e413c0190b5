# SPDX-License-Identifier: Apache-2.0
"""What a campaign says about its driver's commands, from a bounded sample of its drives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_executions import made_execution

from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.status import DRIVES_SAMPLED, driver_habits
from ds_orchestrator.store.model import DriveArrays, Origin, Test
from ds_orchestrator.store.rows import trajectory_sha256
from ds_orchestrator.store.store import Store
from ds_road import generate
from ds_sim import BULLET
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

FRAMES = 40


def store_of(folder: Path, tests: int, factor: float, speed: float) -> Store:
    """Make a campaign whose driver answers a wave times a factor, clipped, at a constant speed."""
    raw = {"siblings": ["bullet"], "twin": "donkey", "driver": "dave2"}
    store = Store(folder / "campaign.sqlite", config=parse_config(raw, "here").identity())
    steering = np.clip(factor * np.sin(np.linspace(0.0, 6.0, FRAMES)), -1.0, 1.0)
    trajectory = np.zeros((FRAMES + 1, 5))
    trajectory[:, 3] = speed
    road = generate(np.random.default_rng(1))
    for number in range(tests):
        test = Test(f"bullet-0-{number:04d}", Scenario(road, seed=1), Origin(BULLET, 0, number))
        store.add_test(test)
        for simulator in ("bullet", "donkey"):
            drive = DriveArrays(trajectory, steering)
            made = made_execution(test.test_id, simulator, Outcome.COMPLETED, steps=FRAMES, drive=drive)
            store.add_execution(replace(made, trajectory_sha256=trajectory_sha256(trajectory)))
    return store


@pytest.mark.parametrize(
    ("factor", "speed", "kinds"),
    [(0.3, 7.0, []), (25.0, 7.0, ["saturated"]), (0.0, 7.0, ["constant"]), (0.3, 0.4, ["crawls"])],
)
def test_names_the_habits_of_the_driver(tmp_path: Path, factor: float, speed: float, kinds: list[str]) -> None:
    assert [habit.kind for habit in driver_habits(store_of(tmp_path, 2, factor, speed))] == kinds


def test_decodes_a_bounded_sample_of_both_simulators(tmp_path: Path) -> None:
    store = store_of(tmp_path, 60, 0.3, 7.0)
    sample = store.sampled_executions(DRIVES_SAMPLED)
    assert DRIVES_SAMPLED / 2 < len(sample) <= DRIVES_SAMPLED
    assert {one.simulator for one in sample} == {"bullet", "donkey"}
    assert {int(one.test_id[-4:]) // 15 for one in sample} == {0, 1, 2, 3}


def test_says_nothing_about_a_campaign_without_drives(tmp_path: Path) -> None:
    assert driver_habits(store_of(tmp_path, 0, 0.3, 7.0)) == ()
