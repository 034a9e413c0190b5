"""Strength at which a driver first fails, over roads: the median road, with an interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from ds_sim.conditions.text import three_digits
from ds_studies.sensitivity.factors import LEVELS, Factor
from ds_studies.sensitivity.measurement import RoadResult

Verdict = Literal[
    "fails", "completes", "infeasible", "lines invisible", "not applicable", "fails by default", "error"
]  # fmt: skip
"""fails: on the median road; completes: it does not, up to the hardest value; infeasible: where it begins to fail on
the median road, the autopilot fails, too; lines invisible: where it begins to fail, they are; not applicable: the
simulator cannot realise the condition; fails by default: too few roads are completed without any condition; error: a
drive ended in an error."""


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
