# SPDX-License-Identifier: Apache-2.0
"""How failures on several simulators lie inside each other, and how vehicles leave their lane."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, product
from typing import Literal, get_args

import numpy as np
from scipy.stats import beta

from ds_analysis.common.driven_road import GRID
from ds_analysis.common.outcome_table import OutcomeTable, RoadTable
from ds_analysis.common.statistics import Array, Bools, Indices, Interval, are_alone, interval_over_families
from ds_road import Road
from ds_road.geometry import lane_curvature
from ds_sim.registry import SimulatorName


@dataclass(frozen=True)
class Nesting:
    """Failures of two simulators on the same roads."""

    first: str
    second: str
    both: int
    only_first: int
    only_second: int
    neither: int
    # Share of the first's failures on which the second fails too; None if the first never fails.
    second_given_first: float | None
    # Its 95% interval: Clopper and Pearson's (Biometrika 26, 1934), or a bootstrap over families where roads descend
    # from each other.
    second_given_first_interval: Interval | None
    first_given_second: float | None
    first_given_second_interval: Interval | None


def nestings(table: OutcomeTable) -> list[Nesting]:
    """Count on which roads each pair of simulators fails, in their order."""
    return [nesting(table, first, second) for first, second in combinations(table.simulators, 2)]


def nesting(table: OutcomeTable, first: SimulatorName, second: SimulatorName) -> Nesting:
    """Count on which roads two simulators fail."""
    one, other = table.failed(first), table.failed(second)
    both, only_first, only_second, neither = (int((a & b).sum()) for a, b in product((one, ~one), (other, ~other)))
    forward, backward = _share(other[one], table.families[one]), _share(one[other], table.families[other])
    return Nesting(first, second, both, only_first, only_second, neither, *forward, *backward)


def _share(failed: Bools, families: Indices) -> tuple[float | None, Interval | None]:
    """Share of failures among roads, and its interval."""
    if not len(failed):
        return None, None
    share = float(failed.mean())
    if 0.0 < share < 1.0 and not are_alone(families):
        interval = interval_over_families((failed.astype(np.float64),), np.mean, families)
        if interval is not None:
            return share, interval
    # Where all are alike, a bootstrap has no width, and a family counts as one observation.
    # The interval is that of Clopper and Pearson.
    alone = len(np.unique(families))
    failures = round(share * alone)
    low = beta.ppf(0.025, failures, alone - failures + 1) if failures else 0.0
    high = beta.isf(0.025, failures + 1, alone - failures) if failures < alone else 1.0
    return share, (float(low), float(high))


Departure = Literal[
    "wide in a right bend",
    "wide in a left bend",
    "cuts a right bend",
    "cuts a left bend",
    "right, straight on",
    "left, straight on",
    "stays in the lane",
    "not recorded",
]
KINDS: tuple[Departure, ...] = get_args(Departure)

LOOK_BACK = 5.0
"""Arc length before the end at which the bend is taken, m; chosen: 0.7 s at 25 km/h, time to cross half a lane."""
STRAIGHT_BELOW = 0.02
"""Curvature below which a lane counts as straight there, 1/m; chosen: a radius of 50 m, ten times a tight bend's."""


@dataclass(frozen=True, kw_only=True)
class Departures:
    """Failures of one simulator by how the vehicle left its lane: out of a bend, into it, on a straight, or not."""

    simulator: SimulatorName
    failures: int
    counts: Mapping[Departure, int]


def departures_of(table: RoadTable) -> list[Departures]:
    """Classify the failures of every simulator, in their order."""
    departures = []
    for name in table.simulators:
        failed, lateral = table.failed(name), table.largest_lateral(name)
        counts = Counter(
            departure(table.roads[k], table.profiles[name][k], float(lateral[k]))
            for k in np.flatnonzero(failed).tolist()
        )
        departures.append(
            Departures(simulator=name, failures=int(failed.sum()), counts={kind: counts[kind] for kind in KINDS})
        )
    return departures


def departure(road: Road, profile: Array, largest: float) -> Departure:
    """Classify a failure by its lateral positions every `GRID` m, and the largest absolute one, m, right positive."""
    if largest < road.lane_width / 2:
        return "stays in the lane"
    if not len(profile):
        return "not recorded"
    to_right = profile[-1] > 0.0
    place = max(len(profile) * GRID - LOOK_BACK, 0.0)
    curvature = float(lane_curvature(road.lane_centre, np.array([place]))[0])
    if abs(curvature) < STRAIGHT_BELOW:
        return "right, straight on" if to_right else "left, straight on"
    if curvature > 0.0:
        return "cuts a right bend" if to_right else "wide in a right bend"
    return "wide in a left bend" if to_right else "cuts a left bend"
