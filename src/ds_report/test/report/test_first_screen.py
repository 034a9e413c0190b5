# SPDX-License-Identifier: Apache-2.0
"""First screen: what it says about campaigns whose outcomes are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from report_campaigns import NOWHERE, campaign_data

from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_report.first_screen import first_screen
from ds_sim.simulator import Outcome


def with_outcomes(folder: Path, config: CampaignConfig, failing: dict[str, set[int]]) -> CampaignData:
    """A campaign of 16 roads, in which each simulator fails exactly the given ones, by position."""
    tests = 16 // len(config.siblings)
    config = config.model_copy(update={"search": SearchConfig(population=tests - 1, iterations=1, runs=1)})
    data = campaign_data(folder, config, tests, roads=16)
    place = {test.test_id: k for k, test in enumerate(data.tests)}
    executions = []
    for one in data.executions:
        failed = place[one.test_id] in failing[one.simulator]
        outcome = Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED
        executions.append(replace(one, outcome=outcome, fitness=-0.1 if failed else 1.0))
    return replace(data, executions=tuple(executions))


def test_the_sibling_that_does_as_the_twin_is_believed(tmp_path: Path) -> None:
    failing = {"a:One": set(range(10)), "b:Two": set(), "c:Three": set(range(9))}
    first = first_screen(with_outcomes(tmp_path, NOWHERE, failing))

    assert "disagree on 10 of 16 tests" in first.believe
    assert "with a:One in 9 and with b:Two in 1: where it has not driven, believe a:One" in first.believe
    assert first.worst and "--failed" in first.command


def test_siblings_that_are_right_equally_often_are_not_believed(tmp_path: Path) -> None:
    failing = {"a:One": set(range(8)), "b:Two": set(), "c:Three": set(range(4))}
    first = first_screen(with_outcomes(tmp_path, NOWHERE, failing))

    assert "with a:One in 4 and with b:Two in 4: too few or too mixed" in first.believe


def test_without_a_twin_nobody_is_believed(tmp_path: Path) -> None:
    config = NOWHERE.model_copy(update={"twin": None})
    first = first_screen(with_outcomes(tmp_path, config, {"a:One": {0, 1}, "b:Two": {1}}))

    assert "only drives on a twin or on your car can say" in first.believe and first.command == "ds real propose ."


ALL_FAIL = "of which the twin fails all, and missed none of the 16 failures"


@pytest.mark.parametrize(
    ("failing", "where", "said", "command"),
    [
        (set(), "none of 16 roads", "completed all 16 tests, and the twin c:Three failed none.", "--min-angle 200"),
        (set(range(16)), "all 16 roads", f"failed 16 of 16 tests, {ALL_FAIL}", "--max-angle 60"),
    ],
)
def test_campaigns_in_which_all_or_nothing_fails_read_as_such(
    tmp_path: Path, failing: set[int], where: str, said: str, command: str
) -> None:
    first = first_screen(with_outcomes(tmp_path, NOWHERE, dict.fromkeys(NOWHERE.simulators, failing)))

    assert f"failed on {where}" in first.where and command in first.command
    assert "The siblings a:One and b:Two agree on all 16 tests: they " in first.believe and said in first.believe


ALONE = NOWHERE.model_copy(update={"siblings": ["a:One"]})
UNTWINNED = ALONE.model_copy(update={"twin": None})
ONE_MISSED = "of which the twin fails 2, and missed 1 of the 3 failures"
MISSED = "completed all 16 tests and missed every one of the"
PAIR = "The siblings a:One and b:Two agree on all 16 tests: they "


@pytest.mark.parametrize(
    ("config", "of_siblings", "of_twin", "said"),
    [
        (ALONE, set(), {1, 2, 3}, f"a:One {MISSED} 3 failures that the twin c:Three"),
        (ALONE, {1, 2, 3}, {1, 2, 9}, f"a:One failed 3 of 16 tests, {ONE_MISSED}"),
        (NOWHERE, set(), {4}, f"{PAIR}{MISSED} 1 failure that the twin c:Three"),
        (NOWHERE, {4}, set(), f"{PAIR}failed 1 of 16 tests, and the twin c:Three failed none."),
        (UNTWINNED, {4}, None, "a:One failed 1 of 16 tests; only drives on a twin or on your"),
    ],
)
def test_siblings_that_never_disagree_are_measured_by_the_twin(
    tmp_path: Path, config: CampaignConfig, of_siblings: set[int], of_twin: set[int] | None, said: str
) -> None:
    failing = dict.fromkeys(config.siblings, of_siblings) | ({} if of_twin is None else {"c:Three": of_twin})
    assert first_screen(with_outcomes(tmp_path, config, failing)).believe.startswith(said)


def test_a_road_that_was_driven_twice_counts_once(tmp_path: Path) -> None:
    data = with_outcomes(tmp_path, NOWHERE, {"a:One": set(range(10)), "b:Two": set(), "c:Three": set(range(9))})
    again = replace(data.tests[0], test_id="a-0-0099")
    drives = [replace(one, test_id="a-0-0099") for one in data.executions if one.test_id == data.tests[0].test_id]
    repeated = replace(data, tests=(*data.tests, again), executions=(*data.executions, *drives))
    assert first_screen(repeated).believe == first_screen(data).believe
    assert first_screen(repeated).where == first_screen(data).where


def test_an_unfinished_campaign_is_to_be_finished(tmp_path: Path) -> None:
    data = with_outcomes(tmp_path, NOWHERE, {name: {0} for name in NOWHERE.simulators})
    first = first_screen(replace(data, executions=data.executions[:-3]))

    assert first.command == "ds campaign resume ."
