# SPDX-License-Identifier: Apache-2.0
"""Comparison of simulators against counts and distances computed by hand, and the sentence about a recorded track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_executions import made_execution

from ds_analysis.common.driven_road import DrivenRoad, lateral_profile
from ds_analysis.common.outcome_table import table_of_runs
from ds_analysis.siblings.analysis import compare, gaps, most_different, summary
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.store.model import Execution
from ds_report.recording_pages import TrackAnswer
from ds_road import Road
from ds_sim import DONKEY, SimulatorName
from ds_sim.simulator import Outcome

A_NAME, B = map(SimulatorName, "ab")

ROAD = Road([(125.0, 25.0 * i) for i in range(9)])


def run(
    outcome: Outcome = Outcome.COMPLETED, lateral: tuple[float, float] = (0.0, 0.0), length: float = 50.0
) -> DrivenRoad:
    """Create a run whose lateral position changes linearly between two values; its speed varies."""
    shares = np.linspace(0.0, 1.0, 21) ** 2
    positions = lateral[0] + shares * (lateral[1] - lateral[0])
    return DrivenRoad(
        road=ROAD,
        outcome=outcome,
        max_lateral_position=float(np.abs(positions).max()),
        profile=lateral_profile(shares * length, positions, ROAD.lane_width / 2),
    )


def test_kappa_is_that_of_the_textbook_table() -> None:
    """20 and 15 agreements of 50, 5 and 10 disagreements: observed 0.7, by chance 0.5, kappa 0.4."""
    fail, drive = Outcome.OUT_OF_BOUNDS, Outcome.COMPLETED
    verdicts = [(fail, fail)] * 20 + [(fail, drive)] * 5 + [(drive, fail)] * 10 + [(drive, drive)] * 15
    verdicts += [(Outcome.DRIVER_SILENT, fail), (drive, Outcome.SIM_ERROR)]
    found = compare(table_of_runs({A_NAME: [run(v[0]) for v in verdicts], B: [run(v[1]) for v in verdicts]}))[0]
    assert (found.both_fail, found.only_first_fails, found.only_second_fails, found.both_complete) == (20, 5, 10, 15)
    assert found.roads == 50 and found.kappa == pytest.approx(0.4)
    # Asymptotic standard error by Fleiss, Cohen and Everitt for this table: 0.127.
    assert found.kappa_interval is not None
    assert found.kappa_interval == pytest.approx((0.4 - 1.96 * 0.127, 0.4 + 1.96 * 0.127), abs=0.005)
    assert summary([run(v[1]) for v in verdicts])["errors"] == 1
    assert summary([run(v[0]) for v in verdicts])["success_rate"] == 26 / 51
    assert summary([run(Outcome.SIM_ERROR)])["success_rate"] is None


def test_where_there_is_no_kappa_it_says_why() -> None:
    runs = [run(), run(Outcome.STUCK)]
    assert compare(table_of_runs({A_NAME: [run(), run()], B: runs}))[0].reason.startswith("a completes every road")
    assert compare(table_of_runs({A_NAME: runs, B: [run(Outcome.STUCK)] * 2}))[0].reason.startswith(
        "b fails every road"
    )
    nothing = compare(table_of_runs({A_NAME: [run(Outcome.SIM_ERROR)], B: [run()]}))[0]
    assert nothing.roads == 0 and nothing.kappa is None and nothing.median_apart is None
    assert nothing.reason == "no road was driven to a verdict on both"


def test_lateral_positions_are_compared_at_the_same_places() -> None:
    """One drifts to 1 m, the other to -1 m over 50 m: 0.04 m apart per metre, 2 m at the end."""
    one, other = run(lateral=(0.0, 1.0)), run(lateral=(0.0, -1.0))
    assert gaps(one.profile, other.profile) == pytest.approx(0.04 * np.arange(0.5, 50.0, 0.5))
    found = compare(table_of_runs({A_NAME: [one], B: [other]}))[0]
    assert found.median_apart == pytest.approx(1.0)
    assert found.most_apart == pytest.approx(1.98)
    assert found.share_apart == pytest.approx(0.75, abs=0.01)
    assert found.correlation == pytest.approx(-1.0)
    # A shorter run is compared as far as it went; a car far off the road counts as at the lane's edge.
    assert len(gaps(one.profile, run(length=20.0).profile)) == 39
    assert gaps(run(lateral=(9.0, 9.0)).profile, run().profile).max() == 2.0
    assert most_different(table_of_runs({A_NAME: [run(), one, one], B: [run(), run(), other]}), 2) == [2, 1]


SEEN, TWIN = SimulatorName("recording@x"), DONKEY
ROADS = [Road([(125, 0), (125, 25), (125, 50), (140 + k, 75)]) for k in range(3)]


def drives(outcomes: str) -> list[Execution | None]:
    """Letters: completed, left its lane, stuck, unknown."""
    kinds = {"c": Outcome.COMPLETED, "l": Outcome.OUT_OF_BOUNDS, "s": Outcome.STUCK}
    return [made_execution("t", SEEN, kinds[one]) if one != "u" else None for one in outcomes]


MINE = DriverName("mine")


def answer(own: str, *, twin: str = "ccc", autopilot: str = "ccc") -> TrackAnswer:
    return TrackAnswer(
        driver=MINE,
        recording=SEEN,
        twin=TWIN,
        roads=ROADS,
        drives={
            (MINE, SEEN): drives(own),
            (MINE, TWIN): drives(twin),
            (AUTOPILOT, SEEN): drives(autopilot),
            (AUTOPILOT, TWIN): drives("ccc"),
        },
        undecided={(MINE, name): ["the car is far"] * of.count("u") for name, of in ((SEEN, own), (TWIN, twin))},
        recorded=[True, False, False],
        limits=["The twin is not fitted."],
    )


@pytest.mark.parametrize(
    ("own", "verdict", "begin"),
    [
        ("ccc", "passes", "mine leaves its lane on 0 of the 3 roads of the recorded track ("),
        ("lcl", "fails", "mine leaves its lane on 2 of the 3 roads of the recorded track ("),
        ("lsc", "fails", "mine leaves its lane on 1 of the 3 roads of the recorded track, and on 1 it stands still"),
        ("ucc", "undecided", "mine leaves its lane on 0 of the 2 roads of the recorded track, while 1 more have no"),
        ("ulc", "fails", "mine leaves its lane on 1 of the 2 roads of the recorded track, while 1 more have no"),
    ],
)
def test_the_sentence_counts(own: str, verdict: str, begin: str) -> None:
    found = answer(own)
    assert found.verdict == verdict
    assert found.sentence.startswith(begin)
    assert found.document()["verdict"] == verdict and len(found.document()["roads"]) == 3


def test_it_names_what_to_compare_with() -> None:
    assert answer("lcc", twin="llc", autopilot="scc").sentence.endswith(
        "(the recorded drive left it on 1 of 3, the autopilot fails on 1 of 3; on the twin mine fails on 2 of 3 and "
        "autopilot fails on 0 of 3)."
    )


def test_what_could_not_be_done_comes_first() -> None:
    cautions = answer("ucc", twin="uuu", autopilot="lcc").cautions
    assert cautions[0] == "The twin is not fitted."
    assert cautions[1] == "On recording@x 1 road without a verdict, such as: the car is far."
    assert cautions[2].startswith("One simulator only: no drive on donkey has a verdict")
    assert cautions[3].startswith("The autopilot, which sees no image, fails on 1 road of the recording, too")
    assert replace(answer("ccc"), limits=()).cautions == []
