"""Section of the report on why tests failed: groups of failures in words, each with a test to replay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ds_analysis.common.selection import ALPHA, most_frequent
from ds_analysis.common.statistics import families_of
from ds_analysis.failures.reasons import Reason, groups_of, reasons_of, where
from ds_orchestrator.campaign.folder import CampaignData
from ds_report.camera_pictures import worst_first
from ds_report.findings import count

MOST_GROUPS = 12
"""Groups that are shown; chosen: a screen. The last ones hold single failures."""


class ShownGroup(NamedTuple):
    """A group of failures, for a page.

    Attributes:
        failures: number of them.
        where: on which simulators.
        worst: the failure whose test fails on most simulators and worst, which a large campaign's page keeps.
        address: of its replay; "" if that test is in no map.
    """

    failures: int
    where: str
    worst: Reason
    address: str


class FailureSection(NamedTuple):
    """Why tests failed: the largest group in words, that of each simulator where they differ; all groups.

    A group is said to lead only if it clearly does (`ds_analysis.common.selection`).
    """

    sentences: Sequence[str]
    groups: Sequence[ShownGroup]


def failure_section(data: CampaignData) -> FailureSection | None:
    """Group a campaign's failures; None if there are none whose frames are known."""
    reasons, data = reasons_of(data), data.distinct
    if not reasons:
        return None
    groups, failed = groups_of(reasons), sum(e.outcome.is_failure for e in data.executions)
    family = dict(zip((t.test_id for t in data.tests), families_of([t.road for t in data.tests]), strict=True))

    def standing_out(of: Sequence[Reason], alpha: float = ALPHA) -> str | None:
        return most_frequent([one.kind for one in of], np.array([family[one.test_id] for one in of], np.intp), alpha)

    first, *others = ((f"{len(of)} of {count(len(reasons), 'failure')}", kind) for kind, of in groups.items())
    sentences = [f"Most often ({first[0]}), the driver {first[1]}."]
    if standing_out(reasons) is None:
        second = f"in {others[0][0].split()[0]} it {others[0][1]}"
        sentences = [f"No way of failing clearly leads: in {first[0]} the driver {first[1]}, {second}."]
    if len(reasons) < failed:
        sentences[0] += f" Read from the records of {len(reasons)} of {failed} failures."
    of_each = {name: [one for one in reasons if one.simulator == name] for name in data.config.simulators}
    clear = {name: standing_out(of, ALPHA / len(of_each)) for name, of in of_each.items() if of}
    if len(set(clear.values()) - {None}) > 1:
        sentences += [f"On {name}, it most often {kind}." for name, kind in clear.items() if kind]
    failing = {reason.test_id for reason in reasons}
    order = worst_first((test for test in data.tests if test.test_id in failing), data.executions)
    rank = {test_id: k for k, test_id in enumerate(order)}
    shown = []
    for group in list(groups.values())[:MOST_GROUPS]:
        worst = min(group, key=lambda reason: rank[reason.test_id])
        cell = data.cells.get(worst.test_id)
        address = "" if cell is None else f"#cell={'-'.join(map(str, cell))}&test={worst.test_id}"
        shown.append(ShownGroup(len(group), where(group), worst, address))
    return FailureSection(sentences, shown)
