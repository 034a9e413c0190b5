# SPDX-License-Identifier: Apache-2.0
"""Finds commands that hint at a wrongly connected driver: saturated, constant, or crawling."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

SATURATED_SHARE = 0.5
"""Share of a drive's commands at full lock from which the driver counts as saturated; chosen: half of a drive."""
CONSTANT_SPREAD = 1e-3
"""Largest difference between commands of a driver that counts as constant; chosen: a tenth of a servo's step."""
CRAWLING = 1.5
"""Mean speed below which a driver counts as crawling, m/s; chosen: at it, 150 m take longer than the limit of a run."""
FEWEST = 20
"""Frames of a drive below which nothing is said: one second."""
_FULL_LOCK = 1.0 - 1e-9


class Habit(NamedTuple):
    """One thing about a driver's commands that its user should know, with its number and the usual cause."""

    kind: Literal["saturated", "constant", "crawls"]
    text: str


def command_habits(steering: NDArray[np.float64], speed: NDArray[np.float64]) -> tuple[Habit, ...]:
    """Find what is unusual in the steering of drives, (frames,) clipped to [-1, 1], and in their speeds, m/s."""
    if len(steering) < FEWEST:
        return ()
    habits = []
    share = float(np.mean(np.abs(steering) >= _FULL_LOCK))
    if share >= SATURATED_SHARE:
        habits.append(
            Habit("saturated", f"{share:.0%} of its steering commands are at full lock: is its output in degrees?")
        )
    if np.ptp(steering) <= CONSTANT_SPREAD:
        habits.append(Habit("constant", f"it always steers {steering[0]:.3f}: does the image reach the network?"))
    mean = float(np.mean(speed))
    if mean < CRAWLING:
        habits.append(Habit("crawls", f"it drives at {3.6 * mean:.1f} km/h on average: is its throttle scaled?"))
    return tuple(habits)
