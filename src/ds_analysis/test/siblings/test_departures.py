# SPDX-License-Identifier: Apache-2.0
"""How failures leave the lane: real drives that are steered out of it, and their mirror images."""

from __future__ import annotations

import numpy as np
import pytest

from ds_analysis.common.driven_road import DrivenRoad
from ds_analysis.common.outcome_table import table_of_runs
from ds_analysis.failures import KINDS, Departure, departure, departures_of
from ds_analysis.siblings.analysis import analyse, analysis_tables
from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_road import Road
from ds_sim.registry import SOFTBODY, SimulatorName, make_simulator
from ds_sim.simulator import Command, Observation, Outcome

B = SimulatorName("b")

RIGHT_BEND = Road([(60, 20), (60, 45), (60, 70), (70, 92), (92, 102), (117, 102), (142, 102), (167, 102)])
"""25 m straight on to the north, then right to the east with a radius of about 25 m, then straight on."""
IN_BEND, ON_STRAIGHT = 38.0, 8.0
MIRRORED: dict[Departure, Departure] = {
    "wide in a right bend": "wide in a left bend",
    "cuts a right bend": "cuts a left bend",
    "right, straight on": "left, straight on",
}


def leave(road: Road, steering: float, after: float) -> DrivenRoad:
    """Drive by the autopilot, and from an arc length on with additional steering, right positive."""
    simulator = make_simulator("softbody")
    autopilot = make_driver("autopilot", simulator.spec)

    def steer(seen: Observation) -> Command:
        found = autopilot(seen)
        away = steering if seen.lane.arc_length >= after else 0.0
        return Command(float(np.clip(found.steering + away, -1.0, 1.0)), found.throttle)

    run = drive_road(simulator, steer, road, 1)
    simulator.close()
    return DrivenRoad.of_run(run)


@pytest.mark.parametrize(
    ("steering", "after", "kind"),
    [
        (-0.8, IN_BEND, "wide in a right bend"),
        (0.8, IN_BEND, "cuts a right bend"),
        (0.8, ON_STRAIGHT, "right, straight on"),
    ],
)
def test_a_drive_that_is_steered_out_of_its_lane_leaves_it_there(
    steering: float, after: float, kind: Departure
) -> None:
    runs = [leave(RIGHT_BEND, steering, after), leave(RIGHT_BEND.mirrored(), -steering, after)]
    assert [run.outcome for run in runs] == [Outcome.OUT_OF_BOUNDS] * 2
    for run, expected in zip(runs, (kind, MIRRORED[kind]), strict=True):
        (found,) = departures_of(table_of_runs({SOFTBODY: [run]}))
        assert found.failures == 1 and [name for name in KINDS if found.counts[name]] == [expected]


def test_failures_in_the_lane_stay_in_it_and_the_table_counts_each_failure_once() -> None:
    assert departure(RIGHT_BEND, np.full(60, 1.0), 1.0) == "stays in the lane"
    assert departure(RIGHT_BEND, np.empty(0), 2.0) == "not recorded"
    out, kept = leave(RIGHT_BEND, 0.8, IN_BEND), leave(RIGHT_BEND, 0.0, IN_BEND)
    assert kept.outcome is Outcome.COMPLETED
    found = analyse(table_of_runs({SimulatorName("a"): [out, kept], B: [kept, kept]}), [B], repeats=1)
    table = analysis_tables(found)[0]
    assert table.name == "sibling_departures" and [row[0] for row in table.rows] == ["a", "b"]
    assert [sum(row[2:]) for row in table.rows] == [row[1] for row in table.rows] == [1, 0]  # type: ignore[arg-type]
    assert found.document()["departures"][0]["counts"]["cuts a right bend"] == 1
