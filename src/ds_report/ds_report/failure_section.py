"""Section of the report on why tests failed: groups of failures in words, each with a test to replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ds_analysis.failures.reasons import FailureGroup, groups_of, reasons_of
from ds_orchestrator.campaign.folder import CampaignData
from ds_report.camera_pictures import worst_first
from ds_report.findings import count

MOST_GROUPS = 12
"""Groups that are shown; chosen: a screen. The last ones hold single failures."""


@dataclass(frozen=True, kw_only=True)
class ShownGroup:
    """One group of failures, for a page.

    Attributes:
        kind: what they have in common, in words that follow "the driver".
        failures: their number.
        where: simulators and their numbers.
        test_id: test of the group that fails on most simulators and worst, whose replay is in the page.
        simulator: where that test failed in this way.
        reason: of that failure, whole.
        address: of its replay within the page; "" if its test is in no map.
    """

    kind: str
    failures: int
    where: str
    test_id: str
    simulator: str
    reason: str
    address: str


@dataclass(frozen=True, kw_only=True)
class FailureSection:
    """Why tests failed, for a page.

    Attributes:
        sentences: the largest group, and that of each simulator where they differ.
        groups: the largest first.
    """

    sentences: Sequence[str]
    groups: Sequence[ShownGroup]


def failure_section(data: CampaignData) -> FailureSection | None:
    """Group a campaign's failures; None if there are none whose frames are known."""
    reasons = reasons_of(data)
    if not reasons:
        return None
    groups, failed = groups_of(reasons), sum(e.outcome.is_failure for e in data.executions)
    failing = {reason.test_id for reason in reasons}
    order = worst_first((test for test in data.tests if test.test_id in failing), data.executions)
    rank = {test_id: k for k, test_id in enumerate(order)}
    sentences = [
        f"Most often the driver {groups[0].kind}: {len(groups[0].reasons)} of {count(len(reasons), 'failure')}."
    ]
    if len(reasons) < failed:
        sentences[0] += f" Read from the records of {len(reasons)} of {failed} failures."
    first = {name: _largest_on(groups, name) for name in data.config.simulators}
    if len({kind for kind in first.values() if kind}) > 1:
        sentences += [f"On {name}, it most often {kind}." for name, kind in first.items() if kind]
    return FailureSection(sentences=sentences, groups=[_shown(group, data, rank) for group in groups[:MOST_GROUPS]])


def _largest_on(groups: Sequence[FailureGroup], simulator: str) -> str:
    on = [(group.by_simulator.get(simulator, 0), group.kind) for group in groups]
    number, kind = max(on, key=lambda one: one[0])
    return kind if number else ""


def _shown(group: FailureGroup, data: CampaignData, rank: dict[str, int]) -> ShownGroup:
    worst = min(group.reasons, key=lambda reason: rank[reason.test_id])
    cell = data.cells.get(worst.test_id)
    return ShownGroup(
        kind=group.kind,
        failures=len(group.reasons),
        where=", ".join(f"{number} on {name}" for name, number in group.by_simulator.items()),
        test_id=worst.test_id,
        simulator=worst.simulator,
        reason=worst.text,
        address="" if cell is None else f"#cell={'-'.join(map(str, cell))}&test={worst.test_id}",
    )
