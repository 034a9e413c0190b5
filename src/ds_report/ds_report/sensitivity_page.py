# SPDX-License-Identifier: Apache-2.0
"""Page of a sensitivity analysis: its table, and pictures at the strengths that break the driver."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from ds_analysis.sensitivity.result import Sensitivity
from ds_report.camera_pictures import CameraPicture, camera_picture
from ds_report.pages import write_page
from ds_sim.conditions.words import in_words

RELOAD = 3
"""Seconds after which an unfinished page asks for itself again; chosen: about a measurement."""


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
        words = in_words(worst.factor.name, worst.factor.value(level))
        return f"{worst.simulator} {words}", self._pictures[key]
