# SPDX-License-Identifier: Apache-2.0
"""Draws at which strength of each condition a driver first fails, the most sensitive condition on top."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_analysis.sensitivity.factors import LEVELS
from ds_analysis.sensitivity.result import Sensitivity
from ds_base.figures import WIDTH, draw_figure, short_name
from ds_sim.conditions.text import format_3sf
from ds_sim.registry import colours_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


WITHSTOOD = frozenset({"completes", "not applicable"})
"""Verdicts that leave nothing to draw."""


def draw_sensitivity(result: Sensitivity, vector: Path | None = None) -> NDArray[np.uint8]:
    """Draw a row for each factor in which something fails or cannot be judged, and name the others below.

    A dot marks the strength at which the median road fails on a simulator, and a line spans the roads. A cross marks
    where no driver can be judged. The value is written beside the first failure of a row. `vector` is as in
    `ds_base.figures.draw_figure`.

    Returns:
        (rows, columns, 3) uint8 RGB.
    """
    colours = colours_of(result.simulators)
    withstood = {
        position: {result.thresholds[position, name].verdict for name in result.simulators} <= WITHSTOOD
        for position in result.order
    }
    drawn = [position for position in result.order if not withstood[position]]
    quiet = [result.factors[position].title for position in result.order if withstood[position]]
    lines = wrap("No failure on any simulator, up to: " + ", ".join(quiet), 120) if quiet else []

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for row, position in enumerate(drawn):
            thresholds = [result.thresholds[position, name] for name in result.simulators]
            first = min((one.fails for one in thresholds if one.fails), default=None)
            for index, one in enumerate(thresholds):
                at, colour = row + 0.6 * ((index + 0.5) / len(thresholds) - 0.5), colours[one.simulator]
                if not (level := one.fails or one.excluded):
                    if one.verdict not in WITHSTOOD:
                        axes.text(0.01, at, one.verdict, va="center", fontsize=8, color=colour)
                    continue
                if one.fails:
                    ends = [(end or LEVELS) / LEVELS for end in one.interval]
                    axes.plot(ends, (at, at), color=colour, linewidth=1.5)
                axes.plot(level / LEVELS, at, "o" if one.fails else "x", color=colour, markersize=6)
                if one.fails == first and first is not None:
                    text = f"{format_3sf(one.factor.value(first))} {one.factor.unit}".strip()
                    box = {"color": "white", "pad": 0.5}
                    axes.text(level / LEVELS - 0.008, at, text, va="center", ha="right", fontsize=8, bbox=box)
                    first = None
        for name, colour in colours.items():
            axes.plot([], [], "o", color=colour, label=f"first fails on {short_name(name)}")
        axes.plot([], [], "x", color="#555555", label="cannot be judged from here")
        axes.set_yticks(range(len(drawn)), [result.factors[position].title for position in drawn])
        axes.set(xlim=(0.0, 1.03), ylim=(len(drawn) - 0.5, -0.5))
        axes.set_xticks((0.0, 1.0), ["no change", "hardest value"])
        axes.set_title(f"Where {result.driver} first fails as a condition gets worse")
        axes.set_xlabel("\n".join(lines), loc="left")
        figure.legend(loc="outside upper right", ncols=len(colours) + 1)

    return draw_figure(WIDTH, 130 + 34 * len(drawn) + 14 * len(lines), draw, vector)
