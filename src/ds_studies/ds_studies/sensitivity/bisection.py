"""Bisects the level at which a driver first fails on one road."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


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
