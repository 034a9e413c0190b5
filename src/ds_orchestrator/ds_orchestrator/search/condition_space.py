"""Conditions that a search varies: their ranges, how they are drawn, and how they are mutated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions, ConditionsError
from ds_sim.conditions.scales import between, share_of

STEP = 0.2
"""Largest mutation of a condition, as a share of its range; chosen: about what 6 m, the largest move of a
control point, are of the 25 m between two of them."""


@dataclass(frozen=True, kw_only=True)
class SearchedCondition:
    """One condition of a search. Steps and draws are uniform on the condition's scale (`ds_sim.conditions.scales`).

    Attributes:
        name: of the condition.
        low: smallest value.
        high: largest value, finite.
        step: largest mutation, as a share of the range.

    Raises:
        ConditionsError: the name is unknown, or the range is none.
    """

    name: str
    low: float
    high: float
    step: float = STEP

    def __post_init__(self) -> None:
        field = FIELDS.get(self.name)
        if field is None:
            raise ConditionsError(f"unknown condition {self.name[:40]!r}: expected some of {', '.join(FIELDS)}")
        if not (field.low <= self.low < self.high <= field.high and math.isfinite(self.high)):
            raise ConditionsError(
                f"{self.name} is searched from {self.low:g} to {self.high:g}: expected a finite range within "
                f"{field.allowed}"
            )
        if not 0.0 < self.step <= 1.0:
            raise ConditionsError(f"{self.name} has steps of {self.step:g} of its range: expected above 0, at most 1")

    def draw(self, rng: np.random.Generator) -> float:
        """Draw a value of the range."""
        return between(self.name, self.low, self.high, float(rng.random()))

    def mutated(self, value: float, rng: np.random.Generator) -> float:
        """Move a value by at most a step; the ends of the range reflect it."""
        share = share_of(self.name, self.low, self.high, value) + float(rng.uniform(-self.step, self.step))
        share = abs(share)
        return between(self.name, self.low, self.high, 2.0 - share if share > 1.0 else share)


@dataclass(frozen=True)
class ConditionSpace:
    """All conditions that a search varies, beside those that it keeps fixed.

    Attributes:
        searched: conditions to vary; none for a search of roads alone.
        fixed: values of the other conditions.

    Raises:
        ConditionsError: a condition is fixed and searched, is searched twice, or the ranges hold values that contradict
            each other.
    """

    searched: Sequence[SearchedCondition] = ()
    fixed: Conditions = DEFAULT

    def __post_init__(self) -> None:
        names = [one.name for one in self.searched]
        for name in names:
            if name in self.fixed.changed:
                raise ConditionsError(f"{name} is fixed and searched: do one of them")
            if names.count(name) > 1:
                raise ConditionsError(f"{name} is searched twice: do it once")
        for end in ("low", "high"):
            self._with({one.name: getattr(one, end) for one in self.searched})

    def __bool__(self) -> bool:
        return bool(self.searched)

    def draw(self, rng: np.random.Generator) -> Conditions:
        """Draw all searched conditions; draws nothing from the generator if there are none."""
        return self._with({one.name: one.draw(rng) for one in self.searched})

    def mutated(self, conditions: Conditions, rng: np.random.Generator) -> Conditions:
        """Mutate one of the searched conditions, chosen uniformly."""
        one = self.searched[int(rng.integers(len(self.searched)))]
        return replace(conditions, **{one.name: one.mutated(getattr(conditions, one.name), rng)})

    def _with(self, values: dict[str, float]) -> Conditions:
        return replace(self.fixed, **values)
