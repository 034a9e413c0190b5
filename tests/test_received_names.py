# SPDX-License-Identifier: Apache-2.0
"""What a received document or a goal names: keys that do not exist, files that are no configuration, large seeds."""

from __future__ import annotations

from pathlib import Path

import pytest

from ds_orchestrator.campaign.config import ConfigError
from ds_road import Road
from ds_sim.scenario import MAX_SEED, Scenario, ScenarioError


@pytest.mark.parametrize(
    "content", ["secret:x:0:0", "secret: {a: 1}\n", "- secret\n", "'secret", "siblings: [secret]\n"]
)
def test_a_goal_that_names_a_file_does_not_get_to_read_it(content: str, tmp_path: Path) -> None:
    from ds_studies.ros.orchestrator_node import _config_of

    path = tmp_path / "passwd"
    path.write_text(content)
    with pytest.raises(ConfigError, match="no configuration that can be read") as refused:
        _config_of(str(path), tmp_path / "campaign", ())
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1, 2**64, 10**400])
def test_a_seed_is_one_that_a_store_can_hold(seed: int) -> None:
    road = Road([(125.0, 25.0 * k) for k in range(5)])
    assert Scenario(road, seed=MAX_SEED).seed == MAX_SEED
    with pytest.raises(ScenarioError, match="expected a whole number from 0"):
        Scenario(road, seed=seed)
