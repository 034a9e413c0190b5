# SPDX-License-Identifier: Apache-2.0
"""Perceptual scales of conditions: interpolates between two values, and inverts that."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

Scale = Literal["linear", "log", "reciprocal"]

_LOG = frozenset({"illuminance", "exposure", "camera_height", "friction", "line_cover_length"})
"""Ratios count: light is measured in stops, mountings and lengths as factors, and the sources of `friction` rank
surfaces from ice (0.12) over snow (0.24) to wet asphalt (0.6) by factors of two."""
_TRANSFORMS: dict[Scale, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "linear": (lambda value: value, lambda value: value),
    "log": (math.log, math.exp),
    "reciprocal": (lambda value: 1.0 / value, lambda value: 1.0 / value if value > 0.0 else math.inf),
}
"""Scale -> from a value, and back."""


def scale_of(name: str) -> Scale:
    """Return the scale of a condition.

    `log` for ratios; `reciprocal` for visibility, whose inverse is the extinction of the air (Koschmieder), 0 where it
    is clear; `linear` for all others, most of which may be 0.
    """
    return "reciprocal" if name == "visibility" else "log" if name in _LOG else "linear"


def between(name: str, start: float, end: float, share: float) -> float:
    """Value of a condition at a share, 0 to 1, of the way from one value to another; both ends are exact."""
    if share in (0.0, 1.0):
        return end if share else start
    there, back = _TRANSFORMS[scale_of(name)]
    value = back(there(start) + share * (there(end) - there(start)))
    low, high = min(start, end), max(start, end)
    return min(max(value, low), high)


def share_of(name: str, start: float, end: float, value: float) -> float:
    """Return the share of the way at which a value lies, in [0, 1]; the inverse of `between`."""
    there, _ = _TRANSFORMS[scale_of(name)]
    return min(max((there(value) - there(start)) / (there(end) - there(start)), 0.0), 1.0)
