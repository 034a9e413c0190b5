"""Section of the report on why tests failed: groups of failures in words, each with a test to replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ds_analysis.failures.reasons import FailureGroup, Reason, groups_of, reasons_of
from ds_orchestrator.campaign.folder import CampaignData
from ds_report.camera_pictures import worst_first
from ds_report.findings import count

MOST_GROUPS = 12
"""Groups that are shown; chosen: a screen. The last ones hold single failures."""


@dataclass(frozen=True, kw_only=True)
class FailureSection:
    """Why tests failed, for a page.

    Attributes:
        sentences: the largest group, and that of each simulator where they differ.
        groups: the largest first, each with the failure whose test fails on most simulators and worst, which a large
            campaign's page keeps, and the address of its replay; "" if that test is in no map.
    """

    sentences: Sequence[str]
    groups: Sequence[tuple[FailureGroup, Reason, str]]


def failure_section(data: CampaignData) -> FailureSection | None:
    """Group a campaign's failures; None if there are none whose frames are known."""
    reasons = reasons_of(data)
    if not reasons:
        return None
    groups, failed = groups_of(reasons), sum(e.outcome.is_failure for e in data.executions)
    most = f"{len(groups[0].reasons)} of {count(len(reasons), 'failure')}"
    sentences = [f"Most often ({most}), the driver {groups[0].kind}."]
    if len(reasons) < failed:
        sentences[0] += f" Read from the records of {len(reasons)} of {failed} failures."
    first = {name: max(groups, key=lambda group: group.on.get(name, 0)) for name in data.config.simulators}
    first = {name: group for name, group in first.items() if name in group.on}
    if len({group.kind for group in first.values()}) > 1:
        sentences += [f"On {name}, it most often {group.kind}." for name, group in first.items()]
    failing = {reason.test_id for reason in reasons}
    order = worst_first((test for test in data.tests if test.test_id in failing), data.executions)
    rank = {test_id: k for k, test_id in enumerate(order)}
    shown = []
    for group in groups[:MOST_GROUPS]:
        worst = min(group.reasons, key=lambda reason: rank[reason.test_id])
        cell = data.cells.get(worst.test_id)
        address = "" if cell is None else f"#cell={'-'.join(map(str, cell))}&test={worst.test_id}"
        shown.append((group, worst, address))
    return FailureSection(sentences=sentences, groups=shown)
