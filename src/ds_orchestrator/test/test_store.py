# SPDX-License-Identifier: Apache-2.0
"""What a store keeps, what of it counts once, and what is said of a driver's commands from a sample of it."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_executions import made_execution

from ds_base.folder_files import StoreError
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.campaign.status import DRIVES_SAMPLED, driver_habits
from ds_orchestrator.store.model import DriveArrays, Origin, Test
from ds_orchestrator.store.rows import trajectory_sha256
from ds_orchestrator.store.store import Store, seconds_of
from ds_road import Road, generate
from ds_sim import BULLET, SimulatorName
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

FOG = Conditions(visibility=50.0)


def test_stages_add_up_over_sessions(tmp_path: Path) -> None:
    store = Store(tmp_path / "campaign.sqlite", config="{}")
    for stage, seconds in (("search", 2.5), ("twin", 7.5), ("search", 1.0)):
        store.add_seconds(stage, seconds)
    store.note("another fact", "3")
    assert seconds_of(store.notes()) == {"twin": 7.5, "search": 3.5}


def test_a_stored_test_keeps_its_road_its_conditions_and_its_origin_if_a_search_made_it(tmp_path: Path) -> None:
    """A road has a lane, a width and a form."""
    sampled = Road.from_road_points([(0, 0), (0, 20), (5, 40)], lane_width=3.5, lane="left")
    tests = [
        Test("any-name", Scenario(sampled, FOG, seed=7)),
        Test("t-1", Scenario(Road([(125, 25 * k) for k in range(5)], maxitwo_compatible=True), seed=0)),
        Test("a-1-0002", Scenario(sampled, seed=8), Origin(SimulatorName("a"), 1, 2)),
    ]
    with closing(Store(tmp_path / "drives.sqlite", config="{}")) as store:
        for test in tests:
            store.add_test(test)
        assert store.tests() == tests


def test_a_full_disk_is_said_and_what_was_stored_stays(tmp_path: Path) -> None:
    with closing(Store(tmp_path / "campaign.sqlite", config="{}")) as store:
        store.note("kept", "1")
        store._file.ask("PRAGMA max_page_count=1")  # which SQLite raises to the present size
        with pytest.raises(StoreError, match="cannot grow, the disk is full: make room, and give the same command ag"):
            store.note("long", "x" * 100_000)
        assert store.notes().keys() == {"config", "kept"}


def test_a_repeated_scenario_is_left_out_with_its_drives() -> None:
    one, other = (generate(np.random.default_rng(seed)) for seed in (1, 2))
    tests = tuple(
        Test(f"bullet-0-{k:04d}", Scenario(road, under, seed=k), Origin(BULLET, 0, k))
        for k, (road, under) in enumerate([(one, DEFAULT), (other, DEFAULT), (one, DEFAULT), (one, FOG), (one, FOG)])
    )
    executions = tuple(made_execution(test.test_id, BULLET, Outcome.COMPLETED) for test in tests)
    data = CampaignData(config=CampaignConfig(), tests=tests, executions=executions, given_up=frozenset({"x"}))
    assert [test.number for test in data.distinct.tests] == [0, 1, 3]
    assert [one.test_id[-1] for one in data.distinct.verdicts] == ["0", "1", "3"]
    assert data.distinct.distinct is data.distinct and not data.distinct.given_up


FRAMES = 40


def store_of(folder: Path, tests: int, factor: float, speed: float) -> Store:
    """Make a campaign whose driver answers a wave times a factor, clipped, at a constant speed."""
    store = Store(folder / "campaign.sqlite", config=CampaignConfig().identity())
    steering = np.clip(factor * np.sin(np.linspace(0.0, 6.0, FRAMES)), -1.0, 1.0)
    trajectory = np.zeros((FRAMES + 1, 5))
    trajectory[:, 3] = speed
    road = generate(np.random.default_rng(1))
    for number in range(tests):
        test = Test(f"bullet-0-{number:04d}", Scenario(road, seed=1), Origin(BULLET, 0, number))
        store.add_test(test)
        drive = DriveArrays(trajectory, steering)
        for simulator in ("bullet", "donkey"):
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
