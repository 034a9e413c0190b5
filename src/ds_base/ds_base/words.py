# SPDX-License-Identifier: Apache-2.0
"""Parts of sentences: lists, counts and durations in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from decimal import Decimal
from difflib import get_close_matches


def listed(parts: Sequence[str], last: str = "and") -> str:
    """Join words as `a`, `a and b`, `a, b and c`."""
    return f" {last} ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def count(number: int, thing: str, plural: str = "") -> str:
    """Count in words: `1 cell`, `2 cells`."""
    return f"{number} {thing if number == 1 else plural or thing + 's'}"


def duration(seconds: float) -> str:
    """Format a duration: `4 s`, `3 min 20 s`, `5 h 07 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.0f} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def multiple(ratio: float) -> str:
    """A ratio to three digits, without an exponent: `368 times`, `0.00425 times`."""
    return f"{Decimal(f'{ratio:.3g}'):,f} times"


def did_you_mean(typed: str, names: Iterable[str]) -> str:
    """End of a message about a name that is none: `, did you mean 'dave2'?`, or nothing if no known one is near."""
    near = get_close_matches(typed.lower(), list(names), 1)
    return f", did you mean {near[0]!r}?" if near else ""
