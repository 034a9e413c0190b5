# SPDX-License-Identifier: Apache-2.0
"""Conditions that are varied one at a time, from a simulator's own world to the hardest value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ds_sim.conditions.actuation import COMMAND_CONDITIONS
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions, ConditionsError
from ds_sim.conditions.scales import between
from ds_sim.conditions.text import check_known

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
    """Factors of some conditions.

    Raises:
        ConditionsError: a name is no condition, has no harder end, or is given twice.
    """
    factors = all_factors()
    all_names = list(dict.fromkeys(factor.name for factor in factors))
    for name in names:
        check_known(name)
        if name not in all_names:
            raise ConditionsError(f"condition {name!r} has no harder end: expected some of {', '.join(all_names)}")
        if list(names).count(name) > 1:
            raise ConditionsError(f"condition {name!r} is named twice: name each once")
    return [factor for factor in factors if factor.name in names]
