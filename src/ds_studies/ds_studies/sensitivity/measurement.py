# SPDX-License-Identifier: Apache-2.0
"""Level of one factor at which a driver first fails: on each road, by bisection, and for the median road."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import shapely

from ds_road import Road, generate
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.conditions.text import three_digits
from ds_sim.oracle import OracleLimits
from ds_sim.scenario import Scenario
from ds_studies.sensitivity.factors import LEVELS, Factor


@dataclass(frozen=True)
class Bracket:
    """Where failing begins on one road.

    Attributes:
        completes: a level that is completed, below `fails`; 0 is taken to be.
        fails: the next level, which fails; None if `completes` is the highest level that was to be driven.
    """

    completes: int
    fails: int | None


def first_failure(fails: Callable[[int], bool], highest: int, near: Bracket | None = None) -> Bracket:
    """Bisect integer levels from 0, which is taken to be completed, to the highest one.

    Where failing is monotone this is the lowest level that fails. Where it is not, it is one of the levels at which
    failing begins: the level below it is completed, it is not.

    Args:
        fails: drives a level from 1 to `highest`, and says whether the driver fails.
        highest: highest level to drive; 0 drives none.
        near: result for a similar road, around which is searched: two drives if it holds here, too.
    """
    if highest == 0:
        return Bracket(0, None)
    low, high = 0, highest + 1

    def drive(level: int) -> None:
        nonlocal low, high
        if low < level < high:
            low, high = (low, level) if fails(level) else (level, high)

    if near is None or near.fails is None:
        drive(highest)
    else:  # search from there in steps that double, as roads differ by little
        drive(near.fails)
        drive(near.fails - 1)
        step = 1
        while high < near.fails and low == 0 and high > 1:
            drive(max(high - step, 1))
            step *= 2
        while low >= near.fails and high > highest and low < highest:
            drive(min(low + step, highest))
            step *= 2
    while high - low > 1:
        drive((low + high) // 2)
    return Bracket(low, high if high <= highest else None)


SEGMENTS = 4
"""Segments of a road, 25 m each, of the six of a generated one: 100 m, on which the car takes up speed on a straight
segment and then takes three bends. Chosen: a drive takes two thirds of the time, and a driver that cannot see fails in
its first bends; one that swings up may need more."""
MOST_SEGMENTS = 6
"""Segments of a generated road: the spline goes from its second control point to the last but one."""
MAX_ANGLE = 270
"""Largest angle of the roads before they are cut, degrees: that of the training roads (paper 4.2.2)."""
CANDIDATES = 3
"""Roads tried for each one needed; chosen: a driver that completes less than a third of them needs no conditions to
fail."""

TESTED, GATE = "tested", "gate"
Fails = Callable[[str, int, Conditions], bool]
"""Whether the driver (`TESTED`) fails on the road of a number under conditions; `GATE`: whether no driver can be judged
there, as the autopilot fails or the lines are invisible (`ds_sim.gates`)."""


@dataclass(frozen=True, kw_only=True)
class RoadResult:
    """One factor on one road; levels of strength are those of `Factor`.

    Attributes:
        completes: highest level that the driver completes below the one at which it fails.
        fails: next level that may be driven, at which it fails; None if it fails at none, or cannot be judged there.
        excluded: that level if the driver fails there and cannot be judged; else None.
    """

    completes: int
    fails: int | None = None
    excluded: int | None = None

    @property
    def withstands_all(self) -> bool:
        """Whether the driver completes the strongest value."""
        return self.fails is None and self.excluded is None


def candidate_roads(count: int, seed: int, *, segments: int = SEGMENTS) -> list[Scenario]:
    """Generate candidates for a number of roads; fewer roads have the same first ones.

    Left out are roads on which a car that never steers stays in its lane: they test nothing.

    Args:
        count: number of roads needed.
        seed: of the roads, and of the runs on the first one.
        segments: segments of 25 m that are kept of each random road, 2 to `MOST_SEGMENTS`.
    """
    rng = np.random.default_rng(seed)
    candidates: list[Scenario] = []
    while len(candidates) < CANDIDATES * count:
        road = Road(generate(rng, max_angle=MAX_ANGLE).control_points[: segments + 3])
        if road.validity.valid and _needs_steering(road):
            candidates.append(Scenario(road, seed=(seed + len(candidates)) % 2**32))
    return candidates


def _needs_steering(road: Road) -> bool:
    """Whether a straight line from the start of the lane leaves it."""
    lane = road.lane_centre
    length = float(np.hypot(*np.diff(lane, axis=0).T).sum())
    ahead = (lane[1] - lane[0]) / np.hypot(*(lane[1] - lane[0]))
    straight = lane[0] + np.outer(np.arange(0.0, length - OracleLimits().finish_margin, 1.0), ahead)
    apart = shapely.distance(shapely.points(straight), shapely.LineString(lane))
    return bool(np.max(apart) > road.lane_width / 2)


def choose_roads(count: int, needed: int, fails: Fails) -> tuple[int, ...]:
    """Numbers of the first roads that the driver completes under default conditions, and that the gates let pass."""
    chosen: list[int] = []
    for road in range(count):
        if len(chosen) < needed and not fails(GATE, road, DEFAULT) and not fails(TESTED, road, DEFAULT):
            chosen.append(road)
    return tuple(chosen)


def measure(factor: Factor, roads: int, fails: Fails, *, levels: int = LEVELS) -> tuple[RoadResult, ...]:
    """Bisect a factor on each road, the strongest value first.

    A drive that the driver completes needs no gate; the gates judge the level at which it begins to fail. As soon as
    the driver completes the strongest value on so many roads that the median cannot fail, no more roads are driven.

    Args:
        factor: what is varied.
        roads: number of roads, all of which the driver completes under default conditions.
        fails: drives.
        levels: number of levels that may be driven, one of `RESOLUTIONS`.

    Returns:
        Results of the roads that were driven, the first ones.
    """
    step = LEVELS // levels
    results: list[RoadResult] = []
    near: Bracket | None = None
    for road in range(roads):
        if sum(one.withstands_all for one in results) > roads // 2:
            break
        near = first_failure(
            lambda level, road=road: fails(TESTED, road, factor.conditions(level * step)),  # type: ignore[misc]
            levels,
            near,
        )
        completes, failing = near.completes * step, None if near.fails is None else near.fails * step
        if failing is not None and fails(GATE, road, factor.conditions(failing)):
            results.append(RoadResult(completes=completes, excluded=failing))
        else:
            results.append(RoadResult(completes=completes, fails=failing))
    return tuple(results)


def is_applicable(factor: Factor, realised: Sequence[str]) -> bool:
    """Whether a simulator that realises some conditions realises a factor."""
    return set(factor.conditions(LEVELS).changed) <= set(realised)


Verdict = Literal[
    "fails", "completes", "infeasible", "lines invisible", "not applicable", "fails by default", "error",
    "pending",
]  # fmt: skip
"""fails: on the median road; completes: it does not, up to the hardest value; infeasible: where it begins to fail on
the median road, the autopilot fails, too; lines invisible: where it begins to fail, they are; not applicable: the
simulator cannot realise the condition; fails by default: too few roads are completed without any condition; error: a
drive ended in an error; pending: not measured yet."""


@dataclass(frozen=True, kw_only=True)
class Threshold:
    """Where a driver first fails, for one factor on one simulator. Levels are as in `Factor`; None is beyond the range.

    Attributes:
        simulator: name of the simulator.
        factor: what is varied.
        verdict: what was found.
        roads: results of the roads.
        message: one line about an error; else "".
    """

    simulator: str
    factor: Factor
    verdict: Verdict
    roads: Sequence[RoadResult] = ()
    message: str = ""

    @property
    def fails(self) -> int | None:
        """Lowest level at which at least half of the roads fail."""
        return _median([road.fails for road in self.roads])

    @property
    def interval(self) -> tuple[int | None, int | None]:
        """Levels at which the first and the last road fail."""
        levels = sorted((road.fails for road in self.roads), key=_beyond_last)
        return (levels[0], levels[-1]) if levels else (None, None)

    @property
    def excluded(self) -> int | None:
        """Level from which the median road cannot be judged: at least half of the roads fail or are excluded there."""
        return None if self.fails else _median([road.fails or road.excluded for road in self.roads])

    @property
    def withstood(self) -> float | None:
        """Share of the range up to the failure of the median road, or as far as it was tested; None without roads."""
        if not self.roads:
            return None
        return (self.fails or self.excluded or LEVELS) / LEVELS

    @property
    def text(self) -> str:
        """What was found, in a few words: the value at which the driver first fails, and the values of all roads."""
        if self.verdict == "fails" and self.fails:
            beyond = "never" if any(road.withstands_all for road in self.roads) else "not judged"
            values = [three_digits(self.factor.value(level)) if level else beyond for level in self.interval]
            median = three_digits(self.factor.value(self.fails))
            return median if values == [median, median] else f"{median} ({' to '.join(dict.fromkeys(values))})"
        if self.verdict == "completes":
            return "no failure"
        if self.verdict in ("infeasible", "lines invisible") and self.excluded:
            return f"{self.verdict} from {three_digits(self.factor.value(self.excluded))}"
        return self.verdict

    def document(self) -> dict[str, Any]:
        """Convert to JSON values; a value beyond the range is None."""
        fails = self.fails if self.verdict == "fails" else None
        first, last = self.interval if fails else (None, None)
        completes = next((road.completes for road in self.roads if fails and road.fails == fails), None)
        return {
            "condition": self.factor.name,
            "unit": self.factor.unit,
            "start": _finite(self.factor.start),
            "end": self.factor.end,
            "simulator": self.simulator,
            "verdict": self.verdict,
            "first_fails": self._value(fails),
            "interval": [self._value(first), self._value(last)],
            "completes": self._value(completes),
            "excluded_from": self._value(self.excluded),
            "share_of_range": self.withstood,
            "message": self.message,
            "roads": [
                {
                    "completes": self._value(road.completes),
                    "fails": self._value(road.fails),
                    "excluded_from": self._value(road.excluded),
                }
                for road in self.roads
            ],
        }

    def _value(self, level: int | None) -> float | None:
        return None if level is None else _finite(self.factor.value(level))


def threshold_of(simulator: str, factor: Factor, roads: Sequence[RoadResult], error: str = "") -> Threshold:
    """Judge the results of the roads of one factor on one simulator."""
    found = Threshold(simulator=simulator, factor=factor, verdict="completes", roads=roads, message=error)
    if error:
        return replace(found, verdict="error")
    if found.fails is not None:
        return replace(found, verdict="fails")
    if found.excluded is None:
        return found
    return replace(found, verdict="infeasible" if factor.moves_vehicle else "lines invisible")


def coverage(roads: int) -> float:
    """Probability that the median of all roads lies between the first and the last of some roads (order statistics)."""
    return 1.0 - 2.0 ** (1 - roads)


def _median(levels: Sequence[int | None]) -> int | None:
    """Lowest level that at least half of the levels do not exceed; None is above all."""
    return sorted(levels, key=_beyond_last)[(len(levels) - 1) // 2] if levels else None


def _beyond_last(level: int | None) -> int:
    return LEVELS + 1 if level is None else level


def _finite(value: float) -> float | None:
    """A value for JSON; the visibility of clear air is infinite, which is None."""
    return value if math.isfinite(value) else None
