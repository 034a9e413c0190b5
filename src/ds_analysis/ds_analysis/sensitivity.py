# SPDX-License-Identifier: Apache-2.0
"""Sensitivity of a driver to conditions: which are varied, at which strength it fails, and ranges to search."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from ds_base.bounded_file import read_json
from ds_base.table import Column, Table, Value, styled
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.network_driver import sees_translated
from ds_sim.conditions.actuation import COMMAND_CONDITIONS
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions, ConditionsError, between
from ds_sim.conditions.text import check_known, format_3sf
from ds_sim.registry import SimulatorName
from ds_sim.scenario import Scenario

LEVELS = 16
"""Levels from a simulator's own world (0) to the hardest value; chosen: a threshold to 6% of the range."""
RESOLUTIONS = (2, 4, 8, 16)
"""Numbers of levels that may be driven: every eighth, every fourth, every second, or each of `LEVELS`."""
VEHICLE_CONDITIONS = COMMAND_CONDITIONS | {"friction", "payload"}
"""Conditions that change how a vehicle moves; the others change what its camera sees, and nothing else."""

_START = {"pavement_reflectance": 0.12, "shadow_depth": 0.0}
"""Value at which a condition changes nothing, where that is not its default: worn asphalt, shadows without depth."""
COMPANIONS = {
    "shadow_depth": {"shadow_density": 0.5},
    "low_sun": {"sun_azimuth": math.pi / 2, "sun_elevation": math.radians(10.0)},
}
"""What a condition needs beside it: shadows on half of the road, for their depth; a sun 10 degrees above the end of the
road's straight beginning, which heads north, as the veil falls with the square of the angle."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """One condition from the value of level 0 to one end of its range, the hardest, at level `LEVELS`."""

    name: str
    start: float
    end: float

    @property
    def unit(self) -> str:
        """Unit of the values; "" for a share or a factor."""
        return FIELDS[self.name].unit

    @property
    def title(self) -> str:
        """Short name with the end of the range, such as `camera_pitch to -0.15 rad`."""
        return f"{self.name} to {self.end:g}{f' {self.unit}' if self.unit else ''}"

    @property
    def moves_vehicle(self) -> bool:
        """Whether it changes how the vehicle moves, and not only what its camera sees."""
        return self.name in VEHICLE_CONDITIONS

    def value(self, level: int) -> float:
        """Value of a level, 0 to `LEVELS`, on the condition's scale."""
        return between(self.name, self.start, self.end, level / LEVELS)

    def conditions(self, level: int) -> Conditions:
        """Conditions of a level; level 0 is each simulator's own world."""
        return Conditions(**COMPANIONS.get(self.name, {}), **{self.name: self.value(level)}) if level else DEFAULT


def all_factors() -> list[Factor]:
    """Every condition with a harder end, in the order of `Conditions`; one with two such ends gives two factors."""
    factors = []
    for name, condition in FIELDS.items():
        start = _START.get(name, getattr(DEFAULT, name))
        ends = {"low": [condition.low], "high": [condition.high], "both": [condition.low, condition.high], "": []}
        factors += [Factor(name=name, start=start, end=end) for end in ends[condition.stronger]]
    return factors


def factors_named(names: Sequence[str]) -> list[Factor]:
    """Factors of some conditions; `ConditionsError` if a name is none, has no harder end, or is given twice."""
    factors = all_factors()
    all_names = list(dict.fromkeys(factor.name for factor in factors))
    for name in names:
        check_known(name)
        if name not in all_names:
            raise ConditionsError(f"condition {name!r} has no harder end: expected some of {', '.join(all_names)}")
        if list(names).count(name) > 1:
            raise ConditionsError(f"condition {name!r} is named twice: name each once")
    return [factor for factor in factors if factor.name in names]


@dataclass(frozen=True, kw_only=True)
class RoadResult:
    """One factor on one road; levels of strength are those of `Factor`."""

    completes: int  # highest level that the driver completes below the one at which it fails
    # Next level that may be driven, at which it fails; None if it fails at none, or there as `excluded`.
    fails: int | None = None
    excluded: int | None = None  # that level if the driver fails there and cannot be judged

    @property
    def withstands_all(self) -> bool:
        """Whether the driver completes the strongest value."""
        return self.fails is None and self.excluded is None


Verdict = Literal[
    "fails", "completes", "infeasible", "lines invisible", "not applicable", "fails by default", "error", "pending"
]
"""fails: on the median road; completes: up to the hardest value; infeasible: where it begins to fail, the autopilot
does, too; lines invisible: where it begins to fail, they are; not applicable: the simulator cannot realise the
condition; fails by default: too few roads are completed without any; error: of a drive; pending: not measured yet."""


@dataclass(frozen=True, kw_only=True)
class Threshold:
    """Where a driver first fails, for one factor on one simulator; levels are as in `Factor`, None is beyond them.

    The message is one line about an error, else "".
    """

    simulator: SimulatorName
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
            values = [format_3sf(self.factor.value(level)) if level else beyond for level in self.interval]
            median = format_3sf(self.factor.value(self.fails))
            return median if values == [median, median] else f"{median} ({' to '.join(dict.fromkeys(values))})"
        if self.verdict == "completes":
            return "no failure"
        if self.verdict in ("infeasible", "lines invisible") and self.excluded:
            return f"{self.verdict} from {format_3sf(self.factor.value(self.excluded))}"
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


def threshold_of(simulator: SimulatorName, factor: Factor, roads: Sequence[RoadResult], error: str = "") -> Threshold:
    """Judge the results of the roads of one factor on one simulator."""
    threshold = Threshold(simulator=simulator, factor=factor, verdict="completes", roads=roads, message=error)
    if error:
        return replace(threshold, verdict="error")
    if threshold.fails is not None:
        return replace(threshold, verdict="fails")
    if threshold.excluded is None:
        return threshold
    return replace(threshold, verdict="infeasible" if factor.moves_vehicle else "lines invisible")


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


@dataclass(frozen=True, kw_only=True)
class Sensitivity:
    """How strong each condition must be for a driver to fail.

    Attributes:
        roads: roads of each simulator; fewer than `needed` where the driver does not complete enough by default.
        thresholds: results by the factor's position and the simulator.
    """

    driver: DriverName
    simulators: Sequence[SimulatorName]
    factors: Sequence[Factor]
    needed: int
    roads: Mapping[SimulatorName, Sequence[Scenario]]
    thresholds: Mapping[tuple[int, str], Threshold]

    @property
    def order(self) -> list[int]:
        """Positions of the factors, the most sensitive one first: least strength withstood on any simulator."""

        def least(position: int) -> float:
            thresholds = [self.thresholds[position, name] for name in self.simulators]
            return min((one.withstood or 1.0 for one in thresholds if one.verdict == "fails"), default=2.0)

        return sorted(range(len(self.factors)), key=lambda position: (least(position), position))

    @property
    def errors(self) -> list[str]:
        """One line for each measurement that ended in an error."""
        return [
            f"{one.factor.title} on {one.simulator}: {one.message}" for one in self.thresholds.values() if one.message
        ]

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "driver": str(self.driver),
            "translated_images": sees_translated(self.driver),
            "simulators": list(self.simulators),
            "roads": {name: [one.road.road_id for one in of] for name, of in self.roads.items()},
            "interval_coverage": coverage(self.needed),
            "thresholds": [
                self.thresholds[position, name].document() for position in self.order for name in self.simulators
            ],
        }

    def table(self) -> Table:
        """One row for each factor, the most sensitive first, one column for each simulator."""
        rows: list[list[Value]] = [
            [self.factors[k].title, *(self.thresholds[k, name].text for name in self.simulators)] for k in self.order
        ]
        notes = [
            f"first failure of the median of {self.needed} roads (of the first to the last road, which hold the median "
            f"of all roads with a probability of {coverage(self.needed):.0%})"
        ]
        notes += [
            f"{name}: {self.driver} completes {len(of)} of {self.needed} roads without any condition: "
            "nothing can be said about conditions"
            for name, of in self.roads.items()
            if len(of) < self.needed
        ]
        if len(self.factors) > 1:
            notes.append(f"the order is that of these {self.needed} roads: on others, another condition may come first")
        if sees_translated(self.driver):
            notes.append(
                f"{self.driver} sees translated images, and a generator may undo what a condition does to them: this "
                "says nothing about its network on images of a real camera under these conditions"
            )
        columns = [Column("condition"), *(Column(name) for name in self.simulators)]
        title = f"Strength at which {self.driver} first fails"
        return Table(name="sensitivity", title=title, columns=columns, rows=rows, notes=notes)

    def long_table(self) -> Table:
        """One row for each factor and simulator, with every number."""
        keys = ["condition", "unit", "end", "simulator", "verdict", "first_fails", "first", "last", "completes"]
        keys += ["excluded_from", "share_of_range", "roads"]
        rows: list[list[Value]] = []
        for one in (self.thresholds[k, name] for k in self.order for name in self.simulators):
            values = one.document()
            values |= {"first": values["interval"][0], "last": values["interval"][1], "roads": len(one.roads)}
            rows.append([values[key] for key in keys])
        return Table(
            name="sensitivity_values",
            title=f"Strength at which {self.driver} first fails, in numbers",
            columns=[
                *styled("text", "condition", "unit"),
                Column("hardest", "number"),
                *styled("text", "simulator", "verdict"),
                *styled("number", "first fails", "first road fails", "last road fails"),
                *styled("number", "completes", "excluded from", "share of range"),
                Column("roads", "count"),
            ],
            rows=rows,
        )


MILDEST = {"visibility": 1000.0}
"""Mild end of a range, where the simulator's own world has none; chosen: the upper limit of fog (WMO-No. 8)."""
RESULT = "sensitivity.json"
"""Result of `ds sensitivity` in its folder."""


def read_ranges(folder: Path) -> dict[str, tuple[float, float]]:
    """Read `ranges_of` the result of `ds sensitivity --out`; `ConditionsError` if the folder holds none."""
    path = folder / RESULT
    try:
        return ranges_of(read_json(path))
    except (OSError, ValueError, KeyError, TypeError):
        raise ConditionsError(f"{path} is no result: expected a folder of `ds sensitivity --out`") from None


def ranges_of(document: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """Range of every condition that makes a driver fail on at least half of the simulators, most sensitive first.

    The document is that of `Sensitivity`. A range reaches from the value that changes nothing to the strength at which
    the (lower) median simulator first fails, or to both hard ends; conditions that need others are left out.
    """
    rows: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for row in document["thresholds"]:
        rows.setdefault((row["condition"], row["end"]), []).append(row)
    ranges: dict[str, tuple[float, float]] = {}
    for (name, _), of in rows.items():
        fails = sorted((row for row in of if row["verdict"] == "fails"), key=lambda row: row["share_of_range"])
        middle = (len(of) - 1) // 2
        if name not in FIELDS or name in COMPANIONS or middle >= len(fails):
            continue
        mild = MILDEST.get(name, fails[middle]["start"])
        ends = (mild, fails[middle]["first_fails"], *ranges.get(name, ()))
        ranges[name] = (float(min(ends)), float(max(ends)))
    return ranges
