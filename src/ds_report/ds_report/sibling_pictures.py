# SPDX-License-Identifier: Apache-2.0
"""Draws failures over a road feature, one panel per simulator, and which simulator fails on which road."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ds_analysis.common.outcome_table import ROAD_FEATURES, OutcomeTable
from ds_base.figures import WIDTH, draw_figure, short_name
from ds_base.palette import FAIL, PASS
from ds_report.heatmap import Picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_failures(table: OutcomeTable, feature: str, vector: Path | None = None) -> Picture:
    """Draw the largest lateral position of at least one test, all judged, over a feature, (rows, columns, 3) RGB."""

    def draw(figure: Figure) -> None:
        values, limits = table.feature(feature), (0.0, 1.08 * float(table.limits.max()))
        panels = figure.subplots(len(table.simulators), sharex=True, squeeze=False)[:, 0]
        for axes, name in zip(panels, table.simulators, strict=True):
            failed, lateral = table.failed(name), table.largest_lateral(name)
            axes.plot(values[~failed], lateral[~failed], "o", color=PASS, fillstyle="none")
            axes.plot(values[failed], lateral[failed], "o", color=FAIL)
            title = f"{name}: fails on {int(failed.sum())} of {len(failed)} roads (discs)"
            axes.set(title=title, ylabel="largest lateral position, m", ylim=limits)
        panels[-1].set_xlabel(_with_unit(feature))

    return draw_figure(WIDTH, 230 * len(table.simulators), draw, vector)


def draw_matrix(table: OutcomeTable, feature: str, vector: Path | None = None) -> Picture:
    """Draw which simulator fails on which road, roads sorted by a feature, as (rows, columns, 3) uint8 RGB."""

    def draw(figure: Figure) -> None:
        order = np.argsort(table.feature(feature), kind="stable")
        axes = figure.subplots()
        for row, name in enumerate(table.simulators):
            failed = np.flatnonzero(table.failed(name)[order])
            axes.barh(row, len(order), height=0.85, color=PASS)
            axes.bar(failed, 0.85, 1.0, row - 0.425, align="edge", color=FAIL, edgecolor="white", linewidth=0.5)
        shown = np.unique(np.round(np.linspace(0, len(order) - 1, 9)).astype(int))
        axes.set_xticks(shown + 0.5, [f"{value:.2g}" for value in table.feature(feature)[order[shown]]])
        axes.set_yticks(range(len(table.simulators)), map(short_name, table.simulators))
        axes.set(xlim=(0, len(order)), ylim=(len(table.simulators) - 0.5, -0.5), xlabel=_with_unit(feature))
        axes.set_title("Who fails where: a column for each road, orange where the driver fails")
        axes.grid(visible=False)

    return draw_figure(WIDTH, 104 + 30 * len(table.simulators), draw, vector)


def _with_unit(feature: str) -> str:
    if feature not in ROAD_FEATURES:
        return f"{feature}, share of its range"
    if "curvature" in feature:
        return f"{feature}, 1/m"
    return f"{feature}, m" if feature == "length" else feature
