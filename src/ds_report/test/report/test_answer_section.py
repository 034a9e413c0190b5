# SPDX-License-Identifier: Apache-2.0
"""The report's section on the car: what it predicts, which cells it marks, and what it says where nothing can be."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from prediction_tables import real_drive
from report_campaigns import NOWHERE, campaign_data, results

from ds_analysis.real.records import write_drives
from ds_base.installation import ds_command
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.search.features import feature_of
from ds_report.build import write_report
from ds_report.sections import AnswerSection, answer_section


def data_of(folder: Path, config: CampaignConfig = NOWHERE, per_sibling: int = 8) -> CampaignData:
    return campaign_data(folder, config, per_sibling, roads=64)


def rows_of(section: AnswerSection) -> list[dict[str, Any]]:
    assert section.cells is not None
    return list(section.cells.document()["rows"])


def test_real_drives_are_marked_and_change_the_answer(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    before = answer_section(tmp_path, data)
    cells = rows_of(before)
    assert sum(cell["tests"] for cell in cells) == len(data.tests) == 16 and not any(cell["driven"] for cell in cells)
    counted = {name: sum(cell["verdict"] == name for cell in cells) for name in ("fails", "safe", "disputed")}
    said = re.findall(r"(\d+) (?:fails?,|(?:is|are) (?:safe|disputed))", before.sentence)
    assert [int(n) for n in said] == [*counted.values()]
    assert "a:One, b:Two and c:Three without a real drive" in before.sentence and "Framed" not in before.reading
    chosen = data.tests[3].test_id
    write_drives(tmp_path, [real_drive(chosen, failed=True)])
    after = answer_section(tmp_path, data)
    (marked,) = (cell for cell in rows_of(after) if cell["driven"])
    labels = [feature_of(name).label(bin_) for name, bin_ in zip(NOWHERE.features, data.cells[chosen], strict=True)]
    assert [marked[name] for name in NOWHERE.features] == labels and after.picture != before.picture
    assert "The car drove 1 test and failed 1" in after.sentence
    (same,) = (cell for cell in cells if [cell[name] for name in NOWHERE.features] == labels)
    assert marked["failure rate"] > same["failure rate"]


def test_the_page_has_the_car_after_the_maps(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    write_drives(tmp_path, [real_drive(data.tests[0].test_id, failed=False)])
    section = answer_section(tmp_path, data)
    html = write_report(tmp_path, data, *results(data), answer=section).read_text()
    assert html.index('id="finding"') < html.index('id="maps"') < html.index('id="answer"')
    part = html[html.index('id="answer"') : html.index('id="comparison"')]
    assert section.picture in part and part.count("<tr>") == len(rows_of(section)) + 1


def test_a_campaign_without_a_twin_has_an_answer(tmp_path: Path) -> None:
    data = data_of(tmp_path, NOWHERE.model_copy(update={"twin": None}))
    section = answer_section(tmp_path, data)
    assert section.picture and "predicted from a:One and b:Two without" in section.sentence
    html = write_report(tmp_path, data, *results(data), answer=section).read_text()
    command = ds_command("real", "propose", tmp_path)
    assert f"`{command}`" in section.reading and f"<code>{command}</code>" in html
    assert "`" not in html[html.index('id="answer"') : html.index('id="comparison"')]


@pytest.mark.parametrize("what", ["few", "damaged", "foreign"])
def test_without_an_answer_the_section_says_why(tmp_path: Path, what: str) -> None:
    data = data_of(tmp_path, per_sibling=2 if what == "few" else 8)
    if what == "damaged":
        write_drives(tmp_path, [])
        (tmp_path / "real" / "drives.json").write_text("{")
    if what == "foreign":
        write_drives(tmp_path, [real_drive("panda-0-0000", failed=True)])
    section = answer_section(tmp_path, data)
    problem = {"few": "expected at least 10", "damaged": "drives.json", "foreign": "of no test here"}[what]
    assert not section.picture and problem in section.sentence and section.sentence.startswith("No prediction")
    assert section.sentence[:30] in write_report(tmp_path, data, *results(data), answer=section).read_text()
