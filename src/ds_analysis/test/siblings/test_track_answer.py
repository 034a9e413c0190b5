# SPDX-License-Identifier: Apache-2.0
"""Parts of the sentence about a recorded track, in closed form from made drives."""

from __future__ import annotations

from dataclasses import replace

import pytest
from made_executions import made_execution

from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.store.model import Execution
from ds_report.recording_pages import TrackAnswer
from ds_road import Road
from ds_sim import DONKEY, SimulatorName
from ds_sim.simulator import Outcome

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
