# SPDX-License-Identifier: Apache-2.0
"""Perceptual scales of conditions: interpolates between two values, and inverts that."""

from __future__ import annotations

import math
from collections.abc import Callable

_LOG = frozenset({"illuminance", "exposure", "camera_height", "friction", "line_cover_length"})
"""Ratios count: light is measured in stops, mountings and lengths as factors, and the sources of `friction` rank
surfaces from ice (0.12) over snow (0.24) to wet asphalt (0.6) by factors of two."""


def _transforms(name: str) -> tuple[Callable[[float], float], Callable[[float], float]]:
    """From a value of a condition to its scale, and back.

    Logarithmic for ratios; reciprocal for visibility, whose inverse is the extinction of the air (Koschmieder), 0 where
    it is clear; linear for all others, most of which may be 0.
    """
    if name == "visibility":
        return lambda value: 1.0 / value, lambda value: 1.0 / value if value > 0.0 else math.inf
    return (math.log, math.exp) if name in _LOG else (float, float)


def between(name: str, start: float, end: float, share: float) -> float:
    """Value of a condition at a share, 0 to 1, of the way from one value to another; both ends are exact."""
    if share in (0.0, 1.0):
        return end if share else start
    there, back = _transforms(name)
    value = back(there(start) + share * (there(end) - there(start)))
    low, high = min(start, end), max(start, end)
    return min(max(value, low), high)


def share_of(name: str, start: float, end: float, value: float) -> float:
    """Return the share of the way at which a value lies, in [0, 1]; the inverse of `between`."""
    there, _ = _transforms(name)
    return min(max((there(value) - there(start)) / (there(end) - there(start)), 0.0), 1.0)
