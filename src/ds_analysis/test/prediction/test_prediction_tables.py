# SPDX-License-Identifier: Apache-2.0
"""Tests as a table: families by pedigree, and what excluded tests and errors may never do."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from report_campaigns import make_campaign, set_conditions

from ds_analysis.common.outcome_table import ROAD_FEATURES, OutcomeTableError, State, table_of_campaign
from ds_analysis.common.statistics import families_of
from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig
from ds_orchestrator.campaign.folder import CampaignData, read_campaign
from ds_road import MutationError, generate, mutate
from ds_sim import BULLET, DONKEY, PANDA
from ds_sim.conditions.model import Conditions
from ds_sim.gates.gate import not_applicable
from ds_sim.simulator import Outcome

CONFIG = CampaignConfig(search=SearchConfig(population=10, iterations=0, runs=1))


def data_of(folder: Path) -> CampaignData:
    store = make_campaign(folder, CONFIG, 8, roads=64)
    store.add_error("bullet-0-0001", "bullet", 0, Outcome.SIM_ERROR, "made up")
    data = read_campaign(store)
    store.close()
    return data


def test_families_are_those_of_a_recorded_pedigree() -> None:
    rng = np.random.default_rng(1)
    roads, roots = [generate(rng, max_angle=220) for _ in range(6)], list(range(6))
    while len(roads) < 80:
        parent = int(rng.integers(len(roads)))
        with suppress(MutationError):
            roads.append(mutate(roads[parent], rng))
            roots.append(roots[parent])
    assert families_of(roads).tolist() == roots


def test_a_sample_of_a_large_campaign_has_whole_families_and_says_so(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    whole, sample = table_of_campaign(data), table_of_campaign(data, most=11)
    assert 0 < len(sample) <= 11 and sample.left_out == len(whole) - len(sample)
    assert f"{sample.left_out} tests" in sample.sample_note and whole.sample_note == ""
    rows = [whole.test_ids.index(test_id) for test_id in sample.test_ids]
    assert rows == sorted(rows) and sample.features.tolist() == whole.features[rows].tolist()
    assert not set(whole.families[rows]) & set(np.delete(whole.families, rows))
    assert len(table_of_campaign(data, most=1)) == 1


def test_a_campaign_becomes_a_table(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    table = table_of_campaign(data)
    assert table.simulators == ("bullet", "softbody", "donkey") and len(table) == 16
    assert table.feature_names == tuple(ROAD_FEATURES)
    of_road = [of(data.tests[3].road) for of in ROAD_FEATURES.values()]
    assert table.features[3].tolist() == of_road
    for one in data.verdicts:
        row, column = table.test_ids.index(one.test_id), table.column(one.simulator)
        assert (table.states[row, column] == State.FAILED) == one.outcome.is_failure
        assert table.lateral[row, column] == min(one.max_lateral_position, 2.0)
    # An error that a later attempt fixed leaves the verdict.
    assert table.known(BULLET).all()
    assert table.cells == tuple(data.cells[test_id] for test_id in table.test_ids)


def test_excluded_tests_and_errors_never_count(tmp_path: Path) -> None:
    """The same campaign without the executions of three tests: two excluded, one that only ever ended in errors."""
    data = data_of(tmp_path)
    excluded = {("bullet-0-0000", BULLET): not_applicable("made up"), ("bullet-0-0002", DONKEY): not_applicable("x")}
    gone = {*excluded, ("bullet-0-0001", "bullet")}
    executions = tuple(e for e in data.executions if (e.test_id, e.simulator) not in gone)
    table = table_of_campaign(replace(data, gates=excluded, executions=executions))
    assert [State(s) for s in table.states[:3, 0]][:2] == [State.EXCLUDED, State.ERROR]
    assert not table.known(BULLET)[:2].any() and not table.failed(BULLET)[:2].any()
    assert table.on_siblings.tolist() == [False, False] + [True] * 14
    assert not table.known(DONKEY)[2] and (table.lateral[:2, 0] == 0).all()
    assert table.judged().roads == table.roads[3:]


def test_searched_conditions_are_features_on_their_scale(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    values = (20.0, 40.0, 80.0)
    tests = tuple(
        set_conditions(test, Conditions(visibility=values[k % 3], line_contrast=0.5))
        for k, test in enumerate(data.tests)
    )
    table = table_of_campaign(replace(data, tests=tests))
    assert table.feature_names[-1] == "visibility"  # line_contrast is the same in all
    # The reciprocal is the extinction of the air: 1/20 at the range's lower end, 0 at clear air.
    assert table.features[:3, -1] == pytest.approx([0.0, 0.5, 0.75])


def test_another_simulator_can_play_the_twin(tmp_path: Path) -> None:
    table = table_of_campaign(data_of(tmp_path))
    turned = table.with_twin(BULLET)
    assert turned.siblings == ("softbody", "donkey") and turned.twin == "bullet"
    assert (turned.failed(BULLET) == table.failed(BULLET)).all()
    with pytest.raises(OutcomeTableError, match="no simulator 'panda', expected one of bullet, softbody, donkey"):
        table.with_twin(PANDA)
    with pytest.raises(OutcomeTableError, match="no test has a verdict yet"):
        table_of_campaign(CampaignData(config=CONFIG))
