# SPDX-License-Identifier: Apache-2.0
"""What a store keeps, and what of it counts once."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from made_executions import made_execution

from ds_base.folder_files import StoreError
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.store.model import Origin, Test
from ds_orchestrator.store.store import Store, seconds_of
from ds_road import Road, generate
from ds_sim import BULLET, SimulatorName
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome


def test_stages_add_up_over_sessions(tmp_path: Path) -> None:
    store = Store(tmp_path / "campaign.sqlite", config="{}")
    for stage, seconds in (("search", 2.5), ("twin", 7.5), ("search", 1.0)):
        store.add_seconds(stage, seconds)
    store.note("another fact", "3")
    assert seconds_of(store.notes()) == {"twin": 7.5, "search": 3.5}


def test_a_stored_road_keeps_its_lane_its_width_and_its_form(tmp_path: Path) -> None:
    roads = [
        Road.from_road_points([(0, 0), (0, 20), (5, 40)], lane_width=3.5, lane="left"),
        Road([(125, 25 * k) for k in range(5)], maxitwo_compatible=True),
    ]
    tests = [Test(f"t-{k}", Scenario(road, seed=k)) for k, road in enumerate(roads)]
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


FOG = Conditions(visibility=50.0)


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


def test_a_test_that_no_search_made_has_no_origin_in_the_store_either(tmp_path: Path) -> None:
    road = generate(np.random.default_rng(1))
    tests = [
        Test("any-name", Scenario(road, FOG, seed=7)),
        Test("a-1-0002", Scenario(road, seed=8), Origin(SimulatorName("a"), 1, 2)),
    ]
    store = Store(tmp_path / "campaign.sqlite", config="{}")
    for test in tests:
        store.add_test(test)
    assert store.tests() == tests
    store.close()
