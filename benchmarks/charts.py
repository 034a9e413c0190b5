"""Line charts with OpenCV: axes with round tick values, solid and dashed lines, dots, a legend."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Rgb = tuple[int, int, int]
INK: Rgb = (30, 30, 30)
GRID: Rgb = (225, 225, 225)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
"""Fractional bits of the pixel coordinates passed to OpenCV."""


@dataclass(kw_only=True)
class Chart:
    """Chart to which lines are added before it is saved.

    Attributes:
        title: text above the chart.
        x_title: text below the x axis.
        y_title: text at the top of the y axis.
        x_range: ends of the x axis.
        y_range: ends of the y axis.
        size: width and height, pixels.
        legend_at: upper left corner of the legend, as shares of the plot's width and height.
        equal: whether both axes have the same scale; `y_range` is then adjusted.
    """

    title: str
    x_title: str
    y_title: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    size: tuple[int, int] = (900, 520)
    legend_at: tuple[float, float] = (0.62, 0.06)
    equal: bool = False
    _names: list[tuple[str, Rgb, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        width, height = self.size
        self._image = np.full((height, width, 3), 255, np.uint8)
        self._left, self._top = 70, 66
        self._wide, self._high = width - 95, height - 120
        if self.equal:
            middle = sum(self.y_range) / 2.0
            half = (self.x_range[1] - self.x_range[0]) * self._high / self._wide / 2.0
            self.y_range = (middle - half, middle + half)
        self._axes()

    def line(
        self, x: NDArray[np.float64], y: NDArray[np.float64], colour: Rgb, name: str = "", *, dash: int = 0
    ) -> None:
        """Draw a line through points; `dash` is the length of dashes and gaps in pixels, 0 for a solid line."""
        points = np.column_stack([self._column(x), self._row(y)])
        steps = np.hypot(*np.diff(points, axis=0).T)
        distance = np.concatenate([[0.0], np.cumsum(steps)])
        # Points at equal distances make dashes of equal length.
        even = np.arange(0.0, distance[-1], 1.0)
        points = np.column_stack([np.interp(even, distance, points[:, k]) for k in (0, 1)])
        plot = self._image[self._top : self._top + self._high, self._left : self._left + self._wide]
        pieces = [points[k : k + dash + 1] for k in range(0, len(points), 2 * dash)] if dash else [points]
        for piece in pieces:
            shifted = np.round((piece - (self._left, self._top)) * 2**_SHIFT).astype(np.int32)
            cv2.polylines(plot, [shifted], False, colour, 2, cv2.LINE_AA, _SHIFT)
        if name:
            self._names.append((name, colour, dash))

    def dots(self, x: NDArray[np.float64], y: NDArray[np.float64], colour: Rgb, name: str = "") -> None:
        """Draw dots at points."""
        for column, row in zip(self._column(x), self._row(y), strict=True):
            cv2.circle(self._image, (round(column * 2**_SHIFT), round(row * 2**_SHIFT)), 4 * 2**_SHIFT, colour, -1,
                       cv2.LINE_AA, _SHIFT)  # fmt: skip
        if name:
            self._names.append((name, colour, -1))

    def save(self, path: Path) -> None:
        """Draw the legend and write the chart as PNG."""
        left = self._left + round(self.legend_at[0] * self._wide)
        for k, (name, colour, dash) in enumerate(self._names):
            row = self._top + round(self.legend_at[1] * self._high) + 20 * k
            if dash < 0:
                cv2.circle(self._image, (left + 18, row), 4, colour, -1, cv2.LINE_AA)
            for start in range(0, 36, 2 * dash) if dash > 0 else [0] * (dash == 0):
                end = start + (dash or 36)
                cv2.line(self._image, (left + start, row), (left + min(end, 36), row), colour, 2, cv2.LINE_AA)
            self._write(name, (left + 44, row + 4))
        cv2.imwrite(str(path), cv2.cvtColor(self._image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])

    def _column(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = self.x_range
        return self._left + (np.asarray(x) - low) / (high - low) * self._wide

    def _row(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = self.y_range
        return self._top + (high - np.asarray(y)) / (high - low) * self._high

    def _axes(self) -> None:
        bottom, right = self._top + self._high, self._left + self._wide
        for value in _ticks(*self.x_range):
            column = round(float(self._column(np.array(value))))
            cv2.line(self._image, (column, self._top), (column, bottom), GRID, 1)
            self._write(f"{value:g}", (column, bottom + 18), middle=True)
        for value in _ticks(*self.y_range):
            row = round(float(self._row(np.array(value))))
            cv2.line(self._image, (self._left, row), (right, row), GRID, 1)
            text = f"{value:g}"
            self._write(text, (self._left - 8 - cv2.getTextSize(text, _FONT, 0.42, 1)[0][0], row + 4))
        cv2.rectangle(self._image, (self._left, self._top), (right, bottom), (150, 150, 150), 1)
        cv2.putText(self._image, self.title, (14, 26), _FONT, 0.6, INK, 2, cv2.LINE_AA)
        self._write(self.y_title, (14, 52))
        self._write(self.x_title, (self._left + self._wide // 2, bottom + 42), middle=True)

    def _write(self, text: str, at: tuple[int, int], *, middle: bool = False) -> None:
        left = at[0] - (cv2.getTextSize(text, _FONT, 0.42, 1)[0][0] // 2 if middle else 0)
        cv2.putText(self._image, text, (left, at[1]), _FONT, 0.42, INK, 1, cv2.LINE_AA)


def _ticks(low: float, high: float) -> list[float]:
    """Four to nine round values within a range."""
    power = 10.0 ** math.floor(math.log10((high - low) / 4.0))
    step = max(m * power for m in (1.0, 2.0, 5.0) if m * power <= (high - low) / 4.0)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 10) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]
