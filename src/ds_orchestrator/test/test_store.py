# SPDX-License-Identifier: Apache-2.0
"""What a store keeps: time per stage over several sessions, and roads."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from ds_base.folder_files import StoreError
from ds_orchestrator.store.model import Test
from ds_orchestrator.store.store import Store, seconds_of
from ds_road import Road
from ds_sim.scenario import Scenario


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
