"""The report's section on why tests failed: counts against the executions, and links that lead to a test."""

from __future__ import annotations

import re
from contextlib import closing
from pathlib import Path

from report_campaigns import make_campaign

from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import read_campaign
from ds_report.failure_section import failure_section
from ds_report.html_report import environment


def test_groups_count_every_failure_once_and_link_to_a_test_of_their_own(tmp_path: Path) -> None:
    config = CampaignConfig(siblings=["bullet", "softbody"], twin=None, driver="autopilot")
    with closing(make_campaign(tmp_path, config, 6)) as store:
        data = read_campaign(store)
        section = failure_section(data)
    assert section is not None
    failed = {(e.test_id, e.simulator) for e in data.executions if e.outcome.is_failure}
    sizes = [group.failures for group in section.groups]
    assert sum(sizes) == len(failed) and sizes == sorted(sizes, reverse=True)
    assert f"({sizes[0]} of {len(failed)} failures)" in section.sentences[0]
    for group in section.groups:
        assert (group.worst.test_id, group.worst.simulator) in failed
        assert sum(int(words.split()[0]) for words in group.where.split(", ")) == group.failures
        assert "-".join(map(str, data.cells[group.worst.test_id])) in group.address
    html = environment().get_template("failures.html.j2").render(failures=section)
    assert re.findall(r'href="#cell=[-\d]+&amp;test=([^"]+)"', html) == [
        group.worst.test_id for group in section.groups
    ]


def test_without_failures_there_is_no_section(tmp_path: Path) -> None:
    config = CampaignConfig(siblings=["bullet"], twin=None, driver="autopilot")
    with closing(make_campaign(tmp_path, config, 0)) as store:
        assert failure_section(read_campaign(store)) is None
