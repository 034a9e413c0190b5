# SPDX-License-Identifier: Apache-2.0
"""What a campaign proposes at its end: the sentence fits what happened, and its command works when it is pasted."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest
from tests.command_line import ds

from ds_cli.output import Result
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig, parse_config, read_config
from ds_report.first_screen import GENTLE, WINDING, proposal
from ds_sim import BULLET

SMALL = {"population": 4, "iterations": 8, "runs": 1}
PASS, FAIL = {"bullet": (0, 24), "donkey": (0, 24)}, {"bullet": (24, 24), "donkey": (24, 24)}


def config(**search: Any) -> CampaignConfig:
    return CampaignConfig(driver=AUTOPILOT, siblings=[BULLET], search=SearchConfig(**{**SMALL, **search}))


def pasted(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> CampaignConfig:
    """The configuration that a proposed command writes, and would run."""
    monkeypatch.chdir(folder)
    run = Result(document={}, show=lambda: None, next="ds models")
    monkeypatch.setattr("ds_cli.campaign.run.campaign", lambda *_, **__: run)
    words = shlex.split(command)
    assert ds(*words[1:]).returncode == 0
    return read_config(folder / words[-1] / "campaign.yaml")


@pytest.mark.parametrize(
    ("tally", "before", "words", "angles"),
    [
        (PASS, config(), "All 48 drives on bullet, donkey pass", WINDING),
        (FAIL, config(), "All 48 drives on bullet, donkey fail", GENTLE),
        (FAIL, config(conditions={"visibility": {"low": 20, "high": 90}}, min_angle=90), "leave out", (90, 300)),
    ],
)
def test_other_roads_are_proposed_where_everything_comes_out_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: Any, before: CampaignConfig, words: str, angles: Any
) -> None:
    found = proposal(tally, before)
    assert found is not None and words in found[0]
    after = pasted(found[1], tmp_path, monkeypatch)
    assert (after.search.min_angle, after.search.max_angle) == angles
    assert after.search.conditions == {} and after.simulators == before.simulators


def test_two_siblings_without_a_twin_stay_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = parse_config({"driver": "autopilot", "twin": "none", "search": SMALL}, "here")
    found = proposal(FAIL, before)
    assert found is not None
    after = pasted(found[1], tmp_path, monkeypatch)
    assert (after.siblings, after.twin) == (before.siblings, None)


def test_at_the_ends_of_the_range_something_else_is_proposed() -> None:
    hard, easy = proposal(PASS, config(min_angle=WINDING[0])), proposal(FAIL, config(min_angle=10, max_angle=60))
    assert hard is not None and hard[1].startswith("ds sensitivity --driver autopilot --sims bullet,donkey")
    assert easy is not None and easy[1].startswith("ds drive --sim bullet --driver autopilot")


def test_nothing_is_proposed_where_tests_differ_or_nothing_was_driven() -> None:
    for tally in ({}, {"bullet": (0, 0)}, {"bullet": (0, 24), "donkey": (1, 24)}, {"bullet": (24, 24), "d": (0, 24)}):
        assert proposal(tally, config()) is None
