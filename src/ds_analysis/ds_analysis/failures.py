# SPDX-License-Identifier: Apache-2.0
"""How a failed drive left its lane or did not finish, and what led there, from its own record."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ds_analysis.common.driven_road import lateral_profile, places_along
from ds_analysis.common.statistics import Array
from ds_analysis.failure_patterns import LOOK_BACK, STRAIGHT_BELOW, departure
from ds_base.table import Column, Table, styled
from ds_driver.control.command_habits import command_habits
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.store.model import Execution, Test
from ds_road import Road
from ds_road.geometry import lane_curvature
from ds_sim.conditions.text import conditions_in_words
from ds_sim.registry import SimulatorName
from ds_sim.simulator import FRAME_TIME, Outcome

MOST_FAILURES = 2_000
"""Failures of a campaign whose records are read; chosen as for the report's other statistics: 2 ms each."""
LATE = 0.25
"""Share of a lane's width by which a car that goes straight on is off when steering late; chosen: half of its room."""
BEGINS = 0.5
"""Share of its mean steering into a bend from which a driver has begun to steer; chosen: halfway there."""
LET_GO = 0.25
"""Time at the end with less than half of the peak's steering, from which a driver has let go, s; chosen: 1.7 m."""
_STEP = 0.5
_HABITS = {"constant": "always steers the same", "saturated": "is at full lock half of the time", "crawls": "crawls"}


class FailureReason(NamedTuple):
    """Why one drive failed, in words that follow "the driver"."""

    test_id: str
    simulator: SimulatorName
    kind: str  # how it left the lane or did not finish, and what led there if the record tells; one for a group
    details: str  # where and how fast, and under which conditions if they are not the default


Groups = Mapping[str, Sequence[FailureReason]]
"""Kind -> failures of this kind in the campaign's order, the largest group first."""


def reasons_of(data: CampaignData) -> list[FailureReason]:
    """Give the reason of every failure that has frames, each scenario once; of evenly spread ones of too many."""
    data = data.distinct
    tests = {test.test_id: test for test in data.tests}
    failed = [e for e in data.executions if e.outcome.is_failure and e.test_id in tests]
    chosen = failed[:: -(-len(failed) // MOST_FAILURES)] if failed else []
    return [reason_of(tests[e.test_id], e) for e in chosen if len(e.trajectory) > 1]


def groups_of(reasons: Sequence[FailureReason]) -> Groups:
    """Group failures by kind, the largest group first, equal ones by their first failure."""
    sizes = Counter(reason.kind for reason in reasons).most_common()
    return {kind: [reason for reason in reasons if reason.kind == kind] for kind, _ in sizes}


def where(group: Sequence[FailureReason]) -> str:
    """Number of failures on each simulator, the most first: `9 on bullet, 2 on donkey`."""
    on = Counter(reason.simulator for reason in group).most_common()
    return ", ".join(f"{number} on {name}" for name, number in on)


def groups_table(groups: Groups) -> Table:
    """Tabulate groups of failures, one row each."""
    columns = [Column("the driver"), Column("failures", "count"), *styled("text", "where", "for example")]
    rows = [(kind, len(group), where(group), group[0].test_id) for kind, group in groups.items()]
    return Table(name="failures", title="Failures by what led there", columns=columns, rows=rows)


def reason_of(test: Test, execution: Execution) -> FailureReason:
    """Give the reason of one failed drive, which has at least two frames."""
    road, trajectory, steering = test.road, execution.trajectory, execution.steering
    arc = np.maximum.accumulate(places_along(road, trajectory))
    kmh = 3.6 * float(np.mean(trajectory[:, 3]))
    numbers = f"{arc[-1]:.0f} m along the road, {kmh:.0f} km/h on average"
    side = 0
    if execution.outcome is Outcome.TIMEOUT:
        how = "is too slow to finish"
    elif execution.outcome is Outcome.STUCK:
        how = "stops on the road"
    else:
        profile = lateral_profile(arc, trajectory[:, 4], road.lane_width / 2)
        kind = departure(road, profile, execution.max_lateral_position)
        side = 1 if "right bend" in kind else -1 if "left bend" in kind else 0
        bend = f"a {'right' if side > 0 else 'left'} bend"
        how = f"runs wide in {bend}" if kind.startswith("wide") else f"cuts {bend}" if side else "leaves a straight"
    habits = command_habits(steering, trajectory[:, 3])
    led = _HABITS[habits[0].kind] if habits else ""
    if not led and how.startswith("cuts"):
        led = "steers too much"
    elif not led and side and len(steering):
        led, since = _steering_into_bend(road, arc[:-1], steering, side)
        numbers += f", steers {since:.1f} s after the bend began" if led == "steers late" else ""
    under = ", ".join(conditions_in_words(name, value) for name, value in test.conditions.changed.items())
    return FailureReason(
        test.test_id,
        execution.simulator,
        f"{how}: it {led}" if led else how,
        f"{numbers}, {under}" if under else numbers,
    )


def _steering_into_bend(road: Road, arc: Array, steering: Array, side: int) -> tuple[str, float]:
    """How a driver that runs wide steers into a bend, and the time from the bend's beginning to the steering's, s.

    `arc`, (steps,) m, is where each command was given; `side` is 1 for a bend to the right, -1 to the left.
    """
    places = np.arange(0.0, max(float(arc[-1]) - LOOK_BACK, 0.0) + _STEP, _STEP)
    curvature = side * lane_curvature(road.lane_centre, places)
    outside = np.flatnonzero(curvature < STRAIGHT_BELOW)
    begin = float(places[outside[-1]]) if len(outside) else 0.0
    first = int(np.searchsorted(arc, begin))
    into = side * steering[first:]
    if not len(into) or float(np.mean(into)) <= 0.0:
        return "steers the wrong way", 0.0
    start = int(np.argmax(into >= BEGINS * np.mean(into)))
    gone = places[(places >= begin) & (places <= arc[first + start])]
    # A car that goes straight on while the lane turns is off by the lane's heading, summed up along the way.
    heading = np.cumsum(side * lane_curvature(road.lane_centre, gone)) * _STEP
    if float(heading.sum()) * _STEP >= LATE * road.lane_width:
        return "steers late", start * FRAME_TIME
    held = np.flatnonzero(into >= BEGINS * np.max(into))[-1]
    if (len(into) - 1 - held) * FRAME_TIME >= LET_GO:
        return "steers in, then lets go", 0.0
    return "steers in time, but too little", 0.0
