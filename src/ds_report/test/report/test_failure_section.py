# SPDX-License-Identifier: Apache-2.0
"""The report's section on why tests failed: counts against the executions, and links that lead to a test."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from report_campaigns import campaign_data

from ds_analysis.failures import FailureReason
from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig
from ds_report.pages import render
from ds_report.sections import failure_section
from ds_sim import BULLET, SOFTBODY


def test_groups_count_every_failure_once_and_link_to_a_test_of_their_own(tmp_path: Path) -> None:
    config = CampaignConfig(siblings=[BULLET, SOFTBODY], twin=None, driver=AUTOPILOT)
    data = campaign_data(tmp_path, config, 6, roads=12)
    section = failure_section(data)
    assert section is not None
    failed = {(e.test_id, e.simulator) for e in data.executions if e.outcome.is_failure}
    sizes = [failures for failures, *_ in section.groups]
    assert sum(sizes) == len(failed) and sizes == sorted(sizes, reverse=True)
    assert f"{sizes[0]} of {len(failed)} failures" in section.sentences[0]
    for failures, where, worst, address in section.groups:
        assert (worst.test_id, worst.simulator) in failed
        assert sum(int(words.split()[0]) for words in where.split(", ")) == failures
        assert "-".join(map(str, data.cells[worst.test_id])) in address
    html = render("failures.html.j2", failures=section)
    linked = re.findall(r'href="#cell=[-\d]+&amp;test=([^"]+)"', html)
    assert linked == [worst.test_id for _, _, worst, _ in section.groups]


@pytest.mark.parametrize(("wide", "said"), [(14, "Most often (14 of 16 failures), the driver wide."), (9, "No way of")])
def test_the_most_frequent_way_of_failing_is_named_only_if_it_leads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wide: int, said: str
) -> None:
    config = CampaignConfig(siblings=[BULLET], twin=None, driver=AUTOPILOT)
    data = campaign_data(tmp_path, config, 16, roads=16)
    kinds = ["wide"] * wide + ["cuts"] * (16 - wide)
    made = [FailureReason(test.test_id, BULLET, kind, "") for test, kind in zip(data.tests, kinds, strict=True)]
    monkeypatch.setattr("ds_report.sections.reasons_of", lambda data: made)
    section = failure_section(data)
    assert section is not None and section.sentences[0].startswith(said)
