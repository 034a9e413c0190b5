# SPDX-License-Identifier: Apache-2.0
"""Draws the study's picture from its tables of cases, without computing anything: a dot for each case.

`python -m benchmarks.when_to_merge.picture [--tables docs/data] [--out docs/images/when_to_merge.png]`
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ds_base.figures import WIDTH, draw_figure
from ds_base.palette import SERIES
from ds_sim.camera.encodings import png

PANELS = {"plain": "Plain tests, four twins", "mild": "Under mild conditions, four simulators as the twin"}
"""Part of a file's name -> title; a panel whose file is missing is left out."""
Rows = Sequence[Mapping[str, str]]


def draw(panels: Mapping[str, Rows]) -> NDArray[np.uint8]:
    """Draw the product's gain over how much more often than the twin the siblings fail; lines are means."""

    def place(case: Mapping[str, str]) -> tuple[float, float]:
        siblings = min(int(case["failed_first"]), int(case["failed_second"]))
        return 100 * (siblings - int(case["failed_twin"])) / int(case["tests"]), float(case["gain"])

    def drawing(figure: Figure) -> None:
        row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (title, cases) in zip(row, panels.items(), strict=True):
            share, gain = np.array([place(case) for case in cases]).T
            for both, colour, words in ((True, SERIES[0], "both fail more often"), (False, SERIES[2], "not both")):
                chosen = (share > 0) == both
                label = f"{words}: {chosen.sum()} cases"
                axes.plot(share[chosen], gain[chosen], "o", color=colour, alpha=0.7, label=label)
                if chosen.any():
                    axes.hlines(gain[chosen].mean(), min(0, share[chosen].min()), max(0, share[chosen].max()), colour)
            axes.axhline(0.0, color="black", linewidth=0.8)
            axes.axvline(0.0, color="black", linewidth=0.8)
            axes.set(title=title, xlabel="failures, % of tests: the sibling that fails less often minus the twin")
            axes.legend(loc="lower right")
        row[0].set_ylabel("r: product minus the better sibling")

    return draw_figure(WIDTH, 420, drawing)


def main() -> None:
    """Read the cases, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", type=Path, default=Path("docs/data"))
    parser.add_argument("--out", type=Path, default=Path("docs/images/when_to_merge.png"))
    arguments = parser.parse_args()
    panels: dict[str, Rows] = {}
    for name, title in PANELS.items():
        if (file := arguments.tables / f"when_to_merge_{name}.csv").exists():
            with file.open(newline="", encoding="utf-8") as table:
                panels[title] = list(csv.DictReader(table))
    arguments.out.write_bytes(png(draw(panels)))


if __name__ == "__main__":
    main()
