# SPDX-License-Identifier: Apache-2.0
"""Draws how much of each condition a driver withstands: a tornado chart, the most sensitive condition on top."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_analysis.sensitivity.factors import LEVELS
from ds_analysis.sensitivity.result import Sensitivity
from ds_base.figures import WIDTH, draw_figure, short_name
from ds_sim.registry import colours_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_sensitivity(found: Sensitivity, vector: Path | None = None) -> NDArray[np.uint8]:
    """Draw one group of bars for each factor, one bar for each simulator.

    A bar reaches to the strength at which the median road fails; a thin line spans the roads. A hollow bar has no
    failure in its end: hollow to the hardest value, or to where no driver can be judged.

    Args:
        found: the analysis.
        vector: see `ds_base.figures.draw_figure`.

    Returns:
        (rows, columns, 3) uint8 RGB.
    """
    share = 0.8 / len(found.simulators)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for index, (name, colour) in enumerate(colours_of(found.simulators).items()):
            axes.barh(np.nan, np.nan, color=colour, label=short_name(name))
            for row, position in enumerate(found.order):
                one, at, end = found.thresholds[position, name], row - 0.4 + (index + 0.5) * share, 0.0
                if one.withstood is not None:
                    fails, end = one.verdict == "fails", one.withstood
                    axes.barh(at, end, 0.8 * share, color=colour if fails else "none", edgecolor=colour)
                    if fails:
                        ends = [(level or LEVELS) / LEVELS for level in one.interval]
                        axes.plot(ends, (at, at), color="black", linewidth=1)
                        end = max(end, ends[1])
                text = one.verdict if one.withstood is None else one.text
                axes.text(end + 0.006, at, text, va="center", fontsize=7)
        axes.set_yticks(range(len(found.order)), [found.factors[position].title for position in found.order])
        axes.set(xlim=(0.0, 1.2), ylim=(len(found.order) - 0.5, -0.5), xlabel="share of the condition's range")
        axes.set_xticks(np.linspace(0.0, 1.0, 6), [f"{10 * tenth} %" for tenth in range(0, 11, 2)])
        axes.grid(visible=False, axis="y")
        axes.set_title(f"Strength at which {found.driver} first fails; hollow: no failure")
        figure.legend(loc="outside lower left", ncols=5)

    return draw_figure(WIDTH, 150 + (13 * len(found.simulators) + 12) * len(found.order), draw, vector)
