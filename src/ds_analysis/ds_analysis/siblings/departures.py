"""How each simulator's failures leave the lane: out of a bend, into it, or on a straight.

Two simulators that fail equally often may fail in different ways, and only such are worth asking both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ds_analysis.paper.simulator_agreement import GRID
from ds_analysis.siblings.outcomes import Outcomes
from ds_road import Road
from ds_road.geometry import lane_curvature

Departure = Literal[
    "wide in a right bend",
    "wide in a left bend",
    "cuts a right bend",
    "cuts a left bend",
    "right, straight on",
    "left, straight on",
    "stays in the lane",
]
KINDS: tuple[Departure, ...] = get_args(Departure)

LOOK_BACK = 5.0
"""Arc length before the end of a drive at which the bend is taken, m; chosen: 0.7 s at 25 km/h, about what it takes to
cross half a lane."""
STRAIGHT_BELOW = 0.02
"""Curvature below which a lane counts as straight there, 1/m; chosen: a radius of 50 m, ten times a tight bend's."""


@dataclass(frozen=True, kw_only=True)
class Departures:
    """Failures of one simulator by how the vehicle left its lane.

    Attributes:
        simulator: name of the simulator.
        failures: number of its failures.
        counts: kind -> number; a failure without leaving the lane, such as being stuck, stays in it.
    """

    simulator: str
    failures: int
    counts: Mapping[Departure, int]

    @property
    def sentence(self) -> str:
        """The most frequent kind, or "" without failures."""
        if not self.failures:
            return ""
        kind = max(KINDS, key=lambda name: self.counts[name])
        return f"{self.simulator} most often: {kind}, {self.counts[kind]} of {self.failures} failures."


def departures_of(outcomes: Outcomes) -> list[Departures]:
    """Classify the failures of every simulator, in their order."""
    found = []
    for name in outcomes.simulators:
        failed, lateral = outcomes.failures(name), outcomes.largest_lateral(name)
        counts: Counter[Departure] = Counter(
            departure(road, profile, float(largest))
            for road, profile, largest, out in zip(
                outcomes.roads, outcomes.profiles[name], lateral, failed, strict=True
            )
            if out
        )
        found.append(
            Departures(simulator=name, failures=int(failed.sum()), counts={kind: counts[kind] for kind in KINDS})
        )
    return found


def departure(road: Road, profile: NDArray[np.float64], largest: float) -> Departure:
    """Classify a failure.

    Args:
        road: the road.
        profile: lateral positions every `GRID` m up to the end of the drive, m, right positive.
        largest: largest absolute lateral position, m, at most half a lane.
    """
    if largest < road.lane_width / 2 or not len(profile):
        return "stays in the lane"
    to_right = profile[-1] > 0.0
    place = max(len(profile) * GRID - LOOK_BACK, 0.0)
    curvature = float(lane_curvature(road.lane_centre, np.array([place]))[0])
    if abs(curvature) < STRAIGHT_BELOW:
        return "right, straight on" if to_right else "left, straight on"
    if curvature > 0.0:
        return "cuts a right bend" if to_right else "wide in a right bend"
    return "wide in a left bend" if to_right else "cuts a left bend"
