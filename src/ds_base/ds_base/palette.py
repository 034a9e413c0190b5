# SPDX-License-Identifier: Apache-2.0
"""Colours of all pages, pictures and terminals, distinguishable with red-green colour blindness; a test computes it."""

from __future__ import annotations

Rgb = tuple[int, int, int]
FAIL, PASS, BETWEEN = "#c24e00", "#56b4e9", "#fbeacb"
"""Vermilion for failures, sky blue for tests that pass, and cream halfway between, for disputed and mixed ones."""
FAIL_ON_DARK = "#ff9d5c"
"""`FAIL` as text on a dark page."""
SERIES = ("#0072b2", "#158a64", "#cc79a7", "#882e72", "#464646")
"""Simulators, or other groups, in order; after Okabe and Ito. None resembles `FAIL`."""
INK, PALE = "#1e1e1e", "#fafafa"
"""Dark and pale text."""
GRASS, ASPHALT, CENTRE_LINE, EDGE_LINE = "#78a569", "#69696e", "#ebc828", "#f5f5f5"
"""A road from above."""


def rgb(colour: str) -> Rgb:
    """Convert `#rrggbb` to 0 ... 255."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def colour_of_share(share: float) -> Rgb:
    """Colour of a share of failures: from `PASS` at 0 over `BETWEEN` to `FAIL` at 1; values outside are clipped."""
    place = min(max(2.0 * float(share), 0.0), 2.0)
    low, high, part = (PASS, BETWEEN, place) if place <= 1.0 else (BETWEEN, FAIL, place - 1.0)
    red, green, blue = (round(a + part * (b - a)) for a, b in zip(rgb(low), rgb(high), strict=True))
    return red, green, blue


def luminance(colour: Rgb) -> float:
    """Relative luminance of a colour (WCAG 2), 0 to 1."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in colour)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def ink_on(colour: Rgb) -> Rgb:
    """Choose `INK` or `PALE` for text, whichever has the higher contrast to a colour (contrast ratio of WCAG 2)."""
    between = ((luminance(rgb(INK)) + 0.05) * (luminance(rgb(PALE)) + 0.05)) ** 0.5 - 0.05
    return rgb(INK if luminance(colour) > between else PALE)
