# SPDX-License-Identifier: Apache-2.0
"""Decides whether a network can be judged by a test on one simulator.

*Validity gate*: the autopilot, which knows the road, must complete the test; else nobody could.
*Visibility gate*: the lines must be visible in the image; else the test is out of the operational design domain.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome, Reason

PROBE_EVERY = 10
"""Frames between two measurements of a run; chosen: half a second, 4 m of road, which is less than the window."""
LEAST_CONTRAST = 0.05
"""Weber contrast below which lines count as invisible: the threshold of CIE and WMO (WMO-No. 8, chapter 9:
meteorological optical range), 2.5 times that of Koschmieder."""
MOST_HIDDEN = 0.5
"""Largest share of the road on which the lines may be invisible; chosen: where they are hidden on most of it, a failure
is the rule, and says more about the road than about the network."""


class GateState(StrEnum):
    """Whether a network can be judged by a test on one simulator."""

    VALID = "valid"
    NOT_APPLICABLE = "not_applicable"
    INFEASIBLE = "infeasible"
    OUT_OF_ODD = "out_of_odd"
    OUT_OF_SIGHT = "out_of_sight"


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Result of both gates of a test on one simulator.

    Attributes:
        state: whether a network can be judged by it.
        message: why not, in one line; "" if it can.
        outcome: how the autopilot's run ended; None if the test is not applicable.
        visible_contrast: Weber contrast of the lines at the start; 0 if the test is not applicable.
        hidden_share: share of the autopilot's way on which the lines were invisible.
    """

    state: GateState
    message: str = ""
    outcome: Outcome | None = None
    visible_contrast: float = 0.0
    hidden_share: float = 0.0

    @property
    def is_valid(self) -> bool:
        """True if a network can be judged by the test."""
        return self.state is GateState.VALID


def not_applicable(message: str) -> Gate:
    """Make the gate of a test that a simulator cannot realise."""
    return Gate(state=GateState.NOT_APPLICABLE, message=message)


def exclusion_of(run: RunRecord) -> Gate | None:
    """Make the gate of a test by which its run shows that nobody can be judged there; None for any other run."""
    states = {Reason.NOT_APPLICABLE: GateState.NOT_APPLICABLE, Reason.OUT_OF_SIGHT: GateState.OUT_OF_SIGHT}
    state = states.get(run.reason)
    return None if state is None else Gate(state=state, message=run.message)


def gate_of(run: RunRecord) -> Gate:
    """Judge a test by the autopilot's run with a `ContrastProbe`.

    Raises:
        ValueError: the run ended in an error, which says nothing about the test.
    """
    if not run.outcome.is_verdict or not run.visible_contrasts:
        raise ValueError(f"the autopilot's run ended {run.outcome.name}: repeat it")
    at_start, hidden = run.visible_contrasts[0], hidden_share(run)
    state, message = GateState.VALID, ""
    if run.outcome.is_failure:
        state = GateState.INFEASIBLE
        message = f"the autopilot ends {run.outcome.name.lower().replace('_', ' ')} after {run.steps} frames"
    elif at_start < LEAST_CONTRAST:
        state = GateState.OUT_OF_ODD
        message = f"the lines have a contrast of {at_start:.1%} at the start, expected {LEAST_CONTRAST:.0%} or more"
    elif hidden > MOST_HIDDEN:
        state = GateState.OUT_OF_ODD
        message = f"the lines are invisible on {hidden:.0%} of the road, expected at most {MOST_HIDDEN:.0%}"
    return Gate(state=state, message=message, outcome=run.outcome, visible_contrast=at_start, hidden_share=hidden)


def hidden_share(run: RunRecord) -> float:
    """Share of the driven way, [0, 1], on which the lines are invisible; what is measured holds until it is again."""
    arcs = [run.observations[i * PROBE_EVERY].lane.arc_length for i in range(len(run.visible_contrasts))]
    ways = np.diff([*arcs, run.observations[-1].lane.arc_length]).clip(min=0.0)
    hidden = np.array(run.visible_contrasts) < LEAST_CONTRAST
    return float(ways[hidden].sum() / ways.sum()) if ways.sum() > 0.0 else float(hidden[0])
