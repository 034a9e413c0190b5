"""Draws failures over a road feature, one panel per simulator, and which simulator fails on which road."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_analysis.common.chart import COLOURS, LEFT, WIDTH, Chart, Picture, write
from ds_analysis.common.outcome_table import ROAD_FEATURES, OutcomeTable
from ds_analysis.common.statistics import Array
from ds_sim.conditions.text import three_digits

_PANEL, _ROW, _HEAD, _FOOT = 230, 30, 64, 40
_FAILS, _DRIVES = COLOURS[1], (205, 222, 235)
_NAME_COLUMN = 150


def draw_failures(table: OutcomeTable, feature: str) -> Picture:
    """Draw the largest lateral position over a feature: failures as discs, completed roads as rings.

    Args:
        table: at least one test, with a verdict on every simulator.
        feature: name of one of its features; the same axis for every simulator.

    Returns:
        (rows, columns, 3) uint8 RGB.
    """
    values = table.feature(feature)
    low, high = float(values.min()), float(values.max())
    margin = 0.03 * (high - low) or 1.0
    most = max(road.lane_width / 2 for road in table.roads)
    panels = []
    for name in table.simulators:
        failed, lateral = table.failed(name), table.largest_lateral(name)
        title = f"{name}: fails on {int(failed.sum())} of {len(failed)} roads (discs)"
        axis = f"{_with_unit(feature)}; upwards: largest lateral position, m"
        chart = Chart(title, axis, (low - margin, high + margin), (0.0, 1.08 * most), _PANEL)
        for value, offset, fails in zip(values, lateral, failed, strict=True):
            chart.point(float(value), float(offset), _FAILS if fails else COLOURS[0], filled=bool(fails))
        panels.append(chart.image)
    return np.vstack(panels)


def draw_matrix(table: OutcomeTable, feature: str) -> Picture:
    """Draw who fails where: a row per simulator, a column per road, by growing feature.

    Returns:
        (rows, columns, 3) uint8 RGB.
    """
    values = table.feature(feature)
    order = np.argsort(values, kind="stable")
    image = np.full((_HEAD + _ROW * len(table.simulators) + _FOOT, WIDTH, 3), 255, np.uint8)
    write(image, "Who fails where: a column for each road, dark where the driver fails", (LEFT, 24), 0.55)
    edges = np.round(np.linspace(_NAME_COLUMN, WIDTH - 24, len(order) + 1)).astype(int)
    for row, name in enumerate(table.simulators):
        top = _HEAD + _ROW * row
        shown = name if len(name) <= 16 else f"{name[:7]}..{name[-7:]}"
        write(image, shown, (8, top + 20), 0.45)
        for column, road in enumerate(order):
            colour = _FAILS if table.failed(name)[road] else _DRIVES
            image[top : top + _ROW - 4, edges[column] : max(edges[column + 1] - 1, edges[column] + 1)] = colour
    _axis(image, values[order], feature, edges)
    return image


def _axis(image: Picture, values: Array, feature: str, edges: NDArray[np.int_]) -> None:
    """Write the feature's values below some of the columns."""
    bottom = image.shape[0] - _FOOT
    for column in np.unique(np.round(np.linspace(0, len(values) - 1, 9)).astype(int)):
        middle = int(edges[column] + edges[column + 1]) // 2
        cv2.line(image, (middle, bottom - 2), (middle, bottom + 3), (90, 90, 90), 1)
        text = three_digits(values[column])
        write(image, text, (min(middle - 4 * len(text), WIDTH - 10 * len(text)), bottom + 17), 0.42)
    write(image, _with_unit(feature), (LEFT, image.shape[0] - 6), 0.45)


def _with_unit(feature: str) -> str:
    if feature not in ROAD_FEATURES:
        return f"{feature}, share of its range"
    if "curvature" in feature:
        return f"{feature}, 1/m"
    return f"{feature}, m" if feature == "length" else feature
