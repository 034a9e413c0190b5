"""Draws a fit: some windows as measured and as fitted, and the residuals."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.encodings import png
from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.fit import Fit
from ds_twin_donkey.logs import CHANNELS

Array = NDArray[np.float64]
Rgb = tuple[int, int, int]
MAX_WINDOWS = 6
"""Number of windows drawn; chosen: as many as can be distinguished."""
_COLOURS: tuple[Rgb, ...] = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (150, 110, 0), (70, 70, 70))
"""Colours of Okabe and Ito, distinguishable with red-green colour blindness."""
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 560, 400, 60, 20, 40, 50
_INK: Rgb = (40, 40, 40)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_fit(fit: Fit, path: Path) -> None:
    """Write a PNG with paths, speed and yaw rate of some windows, and histograms of the residuals over their rms."""
    chosen = np.unique(np.linspace(0, fit.windows - 1, MAX_WINDOWS).round().astype(int))
    frames = fit.measured.shape[1]
    times = [(place * frames + np.arange(frames)) * FRAME_TIME for place in range(len(chosen))]
    origins = fit.fitted[chosen, :1, :2]
    measured = fit.measured[chosen]
    # The last window may be shorter than the others: nothing is measured in the remainder.
    fitted = np.where(np.isfinite(measured).any(axis=2, keepdims=True), fit.fitted[chosen], np.nan)
    paths = list(zip(measured[..., :2] - origins, fitted[..., :2] - origins, strict=True))
    panels = [
        _Panel("Paths from the start of each window", "x, m", "y, m", [p for pair in paths for p in pair], equal=True)
    ]
    for number, (dots, line) in enumerate(paths):
        panels[0].plot(dots, line, _COLOURS[number])
    for title, unit, channel in (("Speed", "m/s", 3), ("Yaw rate", "rad/s", 4)):
        both = [
            (np.column_stack((t, m[:, channel])), np.column_stack((t, f[:, channel])))
            for t, m, f in zip(times, measured, fitted, strict=True)
        ]
        panel = _Panel(f"{title}, windows side by side", "s", unit, [p for pair in both for p in pair])
        for number, (dots, line) in enumerate(both):
            panel.plot(dots, line, _COLOURS[number])
        panels.append(panel)
    panels.append(_histogram(fit))
    rows = [np.hstack([panel.image for panel in panels[i : i + 2]]) for i in (0, 2)]
    head = np.full((36, 2 * _WIDTH, 3), 255, np.uint8)
    text = f"Dots measured, lines fitted: {len(chosen)} of {fit.windows} windows"
    cv2.putText(head, text, (_LEFT, 25), _FONT, 0.6, _INK, 1, cv2.LINE_AA)
    path.write_bytes(png(np.vstack((head, *rows))))


def _histogram(fit: Fit) -> _Panel:
    edges = np.linspace(-4.0, 4.0, 33)
    middle = 0.5 * (edges[1:] + edges[:-1])
    normal = np.column_stack((edges, np.exp(-0.5 * edges**2) / np.sqrt(2.0 * np.pi)))
    drawn = []
    for index, name in enumerate(CHANNELS):
        left = (fit.measured - fit.fitted)[..., index].ravel()
        left = left[np.isfinite(left)]
        if left.size and fit.rms[name] > 0.0:
            height, _ = np.histogram(left / fit.rms[name], edges, density=True)
            drawn.append((index, name, np.column_stack((middle, height))))
    panel = _Panel(
        "Measured minus fitted, over its rms", "rms (grey: normal)", "density", [normal, *(row[2] for row in drawn)]
    )
    panel.line(normal, (170, 170, 170), 3)
    for index, name, points in drawn:
        panel.line(points, _COLOURS[index], 1)
        panel.note(f"{name}: {fit.rms[name]:.2g}", index, _COLOURS[index])
    return panel


class _Panel:
    """Axes with a title, scaled to fit some points.

    Args:
        title: text above the axes.
        x_title: text below the x axis.
        y_title: text at the top of the y axis.
        points: (n, 2) arrays that the axes must contain; NaN rows are ignored.
        equal: whether both axes have the same scale.
    """

    def __init__(self, title: str, x_title: str, y_title: str, points: list[Array], *, equal: bool = False) -> None:
        self.image: NDArray[np.uint8] = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
        every = np.concatenate(points)
        every = every[np.isfinite(every).all(axis=1)]
        low, high = every.min(axis=0), every.max(axis=0)
        margin = 0.05 * np.maximum(high - low, 1e-6)
        self._low, size = low - margin, high - low + 2.0 * margin
        available = np.array([_WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM], dtype=np.float64)
        self._scale = available / size
        if equal:
            self._scale[:] = self._scale.min()
            self._low -= 0.5 * (available / self._scale - size)
        corner = (_WIDTH - _RIGHT, _HEIGHT - _BOTTOM)
        for axis in (0, 1):
            end = self._low[axis] + available[axis] / self._scale[axis]
            for value in _ticks(self._low[axis], end):
                place = self._at(np.array([[value, value]]))[0][axis]
                a, b = ((place, _TOP), (place, corner[1])) if axis == 0 else ((_LEFT, place), (corner[0], place))
                cv2.line(self.image, a, b, (230, 230, 230), 1)
                where = (place - 12, corner[1] + 18) if axis == 0 else (8, place + 5)
                self._write(f"{value:g}", where, 0.42)
        cv2.rectangle(self.image, (_LEFT, _TOP), corner, (120, 120, 120), 1)
        self._write(title, (_LEFT, _TOP - 12), 0.5)
        self._write(x_title, (_WIDTH // 2, _HEIGHT - 10), 0.45)
        self._write(y_title, (6, _TOP - 12), 0.45)

    def plot(self, dots: Array, line: Array, colour: Rgb) -> None:
        """Draw points and a line."""
        for x, y in self._at(dots[np.isfinite(dots).all(axis=1)]):
            cv2.circle(self.image, (x, y), 2, colour, 1, cv2.LINE_AA)
        self.line(line, colour, 1)

    def line(self, points: Array, colour: Rgb, width: int) -> None:
        """Draw a line through points; NaN points are left out."""
        points = points[np.isfinite(points).all(axis=1)]
        cv2.polylines(self.image, [np.array(self._at(points), np.int32)], False, colour, width, cv2.LINE_AA)

    def note(self, text: str, row: int, colour: Rgb) -> None:
        """Write a line of the legend."""
        cv2.putText(self.image, text, (_LEFT + 10, _TOP + 20 + 18 * row), _FONT, 0.42, colour, 1, cv2.LINE_AA)

    def _at(self, points: Array) -> list[tuple[int, int]]:
        pixels = np.rint((points - self._low) * self._scale).astype(int)
        return [(_LEFT + int(x), _HEIGHT - _BOTTOM - int(y)) for x, y in pixels]

    def _write(self, text: str, at: tuple[int, int], size: float) -> None:
        cv2.putText(self.image, text, at, _FONT, size, _INK, 1, cv2.LINE_AA)


def _ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / 5.0
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(m * power - rough))
    return [round(k * step, 9) + 0.0 for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]
