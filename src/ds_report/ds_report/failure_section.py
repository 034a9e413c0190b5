# SPDX-License-Identifier: Apache-2.0
"""Section of the report on why tests failed: groups of failures in words, each with a test to replay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ds_analysis.common.selection import most_frequent
from ds_analysis.common.statistics import families_of
from ds_analysis.failures.reasons import Reason, groups_of, reasons_of, where
from ds_base.words import count
from ds_orchestrator.campaign.folder import CampaignData
from ds_report.camera_pictures import worst_first

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
    """Why tests failed: the largest group in words, and whether it clearly leads; all groups."""

    sentences: Sequence[str]
    groups: Sequence[ShownGroup]


def failure_section(data: CampaignData) -> FailureSection | None:
    """Group a campaign's failures; None if there are none whose frames are known."""
    reasons, data = reasons_of(data), data.distinct
    if not reasons:
        return None
    groups, failed = groups_of(reasons), sum(e.outcome.is_failure for e in data.executions)
    family = dict(zip((t.test_id for t in data.tests), families_of([t.road for t in data.tests]), strict=True))
    families = np.array([family[one.test_id] for one in reasons], np.intp)
    first, *others = ((f"{len(of)} of {count(len(reasons), 'failure')}", kind) for kind, of in groups.items())
    sentences = [f"Most often ({first[0]}), the driver {first[1]}."]
    if most_frequent([one.kind for one in reasons], families) is None:
        second = f"in {others[0][0].split()[0]} it {others[0][1]}"
        sentences = [f"No way of failing clearly leads: in {first[0]} the driver {first[1]}, {second}."]
    if len(reasons) < failed:
        sentences[0] += f" Read from the records of {len(reasons)} of {failed} failures."
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
