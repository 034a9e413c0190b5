# SPDX-License-Identifier: Apache-2.0
"""A campaign counts a road under the same conditions once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from made_executions import made_execution

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.store.model import Origin, Test
from ds_orchestrator.store.store import Store
from ds_road import generate
from ds_sim import BULLET, SimulatorName
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome

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
