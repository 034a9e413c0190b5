# SPDX-License-Identifier: Apache-2.0
"""Page of a sensitivity analysis: its table, and pictures at the strengths that break the driver; its picture."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ds_analysis.sensitivity import LEVELS, Sensitivity
from ds_base.figures import WIDTH, draw_figure, short_name
from ds_report.camera_pictures import CameraPicture, camera_picture
from ds_report.pages import write_page
from ds_sim.conditions.text import conditions_in_words, format_3sf
from ds_sim.registry import colours_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RELOAD = 3
"""Seconds after which an unfinished page asks for itself again; chosen: about a measurement."""
WITHSTOOD = frozenset({"completes", "not applicable"})
"""Verdicts that leave nothing to draw."""


@dataclass
class SensitivityPage:
    """Writes the page after each measurement; a browser that shows it reloads it until the analysis is finished."""

    path: Path
    _pictures: dict[tuple[int, str], CameraPicture] = field(default_factory=dict)

    def write(self, result: Sensitivity) -> None:
        """Write what is known."""
        pending = sum(one.verdict == "pending" for one in result.thresholds.values())
        write_page(
            self.path,
            "sensitivity.html.j2",
            found=result,
            rows=[
                (result.factors[k], [result.thresholds[k, name] for name in result.simulators]) for k in result.order
            ],
            pictures={result.factors[k].title: self._picture(result, k) for k in result.order},
            pending=pending,
            total=len(result.thresholds),
            reload=RELOAD,
        )

    def _picture(self, result: Sensitivity, position: int) -> tuple[str, CameraPicture] | None:
        """The view on the simulator that withstands least, at the strength at which its median road fails."""
        failing = [result.thresholds[position, name] for name in result.simulators]
        failing = [one for one in failing if one.verdict == "fails"]
        if not failing:
            return None
        worst = min(failing, key=lambda one: one.fails or 0)
        level = worst.fails or 0
        key = (position, f"{worst.simulator} {level}")
        if key not in self._pictures:
            first = result.roads[worst.simulator][0]
            scenario = replace(first, conditions=worst.factor.conditions(level))
            self._pictures[key] = camera_picture(worst.simulator, scenario)
        words = conditions_in_words(worst.factor.name, worst.factor.value(level))
        return f"{worst.simulator} {words}", self._pictures[key]


def draw_sensitivity(result: Sensitivity, vector: Path | None = None) -> NDArray[np.uint8]:
    """Draw a row for each factor in which something fails or cannot be judged, as (rows, columns, 3) uint8 RGB.

    A dot marks where the median road fails on a simulator, a line spans the roads, a cross marks where no driver can be
    judged. `vector` is as in `ds_base.figures.draw_figure`.
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
