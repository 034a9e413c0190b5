# SPDX-License-Identifier: Apache-2.0
"""Identities of maps: stable names in files and JSON documents, whatever the simulators are called."""

from __future__ import annotations

import numpy as np
import pytest

from ds_orchestrator.maps import algebra
from ds_orchestrator.maps.algebra import OPERATORS, merged_interval
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId, compared_ids, map_ids, maps_frame
from ds_orchestrator.search.features import DEFAULT_AXES
from ds_sim import SimulatorName

T, TRICKY = map(SimulatorName, ("t", "path_to_x:Sim"))


def test_every_map_of_a_campaign_has_an_identity_of_its_own() -> None:
    ids = map_ids([SimulatorName("a"), SimulatorName("b")], T, ["mean"])
    migrations = "migration_a_to_b migration_a_to_t migration_b_to_a migration_b_to_t"
    names = f"search_a search_b {migrations} union_a union_b merged merged_mean twin_t"
    assert [map_id.name for map_id in ids] == names.split()
    assert len(set(ids)) == len(ids)
    assert [map_id.name for map_id in compared_ids(ids)] == ["union_a", "union_b", "merged", "twin_t"]


def test_an_interval_does_not_depend_on_the_order_of_the_operators(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean of 3 of 9 and 4 of 9 keeps the seed of the first version, its position in the list."""
    counts = [(3, 9), (4, 9)]
    before = {name: merged_interval(name, counts) for name in OPERATORS}
    algebra._merged_interval.cache_clear()
    monkeypatch.setattr(algebra, "OPERATORS", dict(reversed(list(OPERATORS.items()))))
    assert {name: merged_interval(name, counts) for name in OPERATORS} == before
    assert len({operator.seed for operator in OPERATORS.values()}) == len(OPERATORS)
    rng = np.random.default_rng([3, 3, 9, 4, 9])
    draws = rng.beta([[3.5], [4.5]], [[6.5], [5.5]], (2, algebra.DRAWS)).mean(axis=0)
    assert before["mean"] == pytest.approx(tuple(np.quantile(draws, [0.025, 0.975])), rel=1e-12)


def test_maps_as_a_frame() -> None:
    full = MapCell(tests=4, failures=1, probability=0.25, quality_loss=0.5, interval=(0.1, 0.6))
    bare = MapCell(tests=2, failures=None, probability=0.0, quality_loss=0.0)
    maps = {
        one.id: one
        for one in (
            FeatureMap(id=MapId.migration(TRICKY, T), cells={(3, 12): full, (2, 9): bare}, excluded={(3, 12): 2}),
            FeatureMap(id=MapId.merged(), cells={(2, 9): bare}),
            FeatureMap(id=MapId.twin(T), cells={}),
        )
    }
    frame = maps_frame(maps)
    columns = "map kind simulator origin operator turns_count curvature tests failures probability"
    assert list(frame.columns) == f"{columns} interval_low interval_high quality_loss excluded".split()
    places = frame[["kind", "turns_count", "curvature"]].to_numpy().tolist()
    assert places == [["migration", 2, 9], ["migration", 3, 12], ["merged", 2, 9]]
    row = frame.iloc[1]
    assert (row.origin, row.simulator, row.failures, row.interval_high) == (TRICKY, "t", 1, 0.6)
    assert frame.failures.isna().tolist() == [True, False, True] and frame.interval_low.isna().tolist()[0]
    assert frame.excluded.tolist() == [0, 2, 0]
    assert len(maps_frame({})) == 0
    other = FeatureMap(id=MapId.merged("mean"), cells={}, features=DEFAULT_AXES[::-1])
    with pytest.raises(ValueError, match="maps of different features"):
        maps_frame({**maps, other.id: other})
