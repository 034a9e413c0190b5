"""Draws panels with axes, for pictures of results."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Rgb = tuple[int, int, int]
COLOURS: tuple[Rgb, ...] = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (150, 110, 0), (70, 70, 70))
"""Okabe and Ito's palette, safe for red-green colour blindness; repeats for further groups."""
WIDTH, LEFT = 1140, 78
"""Pixels of every panel, and of the space to the left of its axes."""
_RIGHT, _TOP, _BOTTOM = 24, 42, 52
INK: Rgb = (30, 30, 30)
_FAINT: Rgb = (225, 225, 225)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4


class Chart:
    """Panel with axes.

    Args:
        title: heading of the panel.
        unit: title of the x axis.
        x: limits of the x axis.
        y: limits of the y axis.
        height: height of the panel, pixels.

    Attributes:
        image: (height, WIDTH, 3) uint8 RGB.
    """

    def __init__(self, title: str, unit: str, x: tuple[float, float], y: tuple[float, float], height: int) -> None:
        self.image = np.full((height, WIDTH, 3), 255, np.uint8)
        self._x, self._y = x, y
        self._size = np.array([WIDTH - LEFT - _RIGHT, height - _TOP - _BOTTOM], dtype=np.float64)
        self._corner = np.array([LEFT, height - _BOTTOM], dtype=np.float64)
        write(self.image, title, (LEFT, 24), 0.55)
        for value in _ticks(*x):
            at = int(self._pixels(np.array([value]), np.array([y[0]]))[0, 0] / (1 << _SHIFT))
            cv2.line(self.image, (at, _TOP), (at, height - _BOTTOM), _FAINT, 1)
            write(self.image, f"{value:g}", (at - 4 * len(f"{value:g}"), height - _BOTTOM + 18), 0.42)
        for value in _ticks(*y):
            at = int(self._pixels(np.array([x[0]]), np.array([value]))[0, 1] / (1 << _SHIFT))
            cv2.line(self.image, (LEFT, at), (WIDTH - _RIGHT, at), _FAINT, 1)
            write(self.image, f"{value:g}", (LEFT - 10 - 8 * len(f"{value:g}"), at + 5), 0.42)
        write(self.image, unit, (LEFT, height - 12), 0.45)

    def _pixels(self, x: Array, y: Array) -> NDArray[np.int32]:
        low, high = np.array([self._x[0], self._y[0]]), np.array([self._x[1], self._y[1]])
        part = np.clip((np.column_stack((x, y)) - low) / (high - low), 0.0, 1.0) * (1.0, -1.0)
        return np.round((self._corner + part * self._size) * (1 << _SHIFT)).astype(np.int32)

    def line(self, x: Array, y: Array, colour: Rgb, width: int) -> None:
        """Draw a line through points; NaN interrupts it, points beyond the axes are clipped to the border."""
        for block in np.split(np.arange(len(y)), np.flatnonzero(np.diff(np.isfinite(y))) + 1):
            if len(block) > 1 and np.isfinite(y[block[0]]):
                points = self._pixels(x[block], y[block])
                cv2.polylines(self.image, [points], False, colour, width, cv2.LINE_AA, _SHIFT)

    def point(self, x: float, y: float, colour: Rgb, *, filled: bool) -> None:
        """Draw a disc, or a ring; points beyond the axes lie on the border."""
        at = self._pixels(np.array([x]), np.array([y]))[0]
        centre = (int(at[0]), int(at[1]))
        if filled:
            cv2.circle(self.image, centre, 5 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
        else:
            cv2.circle(self.image, centre, 4 << _SHIFT, colour, 2, cv2.LINE_AA, _SHIFT)

    def note(self, text: str, number: int, colour: Rgb, *, across: bool = False) -> None:
        """Write a line of the legend."""
        x = WIDTH - _RIGHT - 220 + 110 * number if across else LEFT + 14
        y = 24 if across else _TOP + 20 + 20 * number
        cv2.line(self.image, (x, y - 5), (x + 18, y - 5), colour, 3)
        write(self.image, text, (x + 26, y), 0.45)


def _ticks(low: float, high: float) -> list[float]:
    """Choose four to nine round values between two limits."""
    rough = (high - low) / 6
    power = 10.0 ** np.floor(np.log10(rough))
    step = float(min(power * np.array([1.0, 2.0, 5.0, 10.0]), key=lambda s: abs(np.log(s / rough))))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [round(i * step, 10) for i in range(first, last + 1)]


def write(
    image: Picture,
    text: str,
    at: tuple[int, int],
    size: float,
    *,
    ink: Rgb = INK,
    anchor: Literal["start", "middle", "end"] = "start",
    thickness: int = 1,
) -> None:
    """Write text with its start, middle or end at a pixel of the baseline."""
    width = text_width(text, size, thickness)
    left = at[0] - {"start": 0, "middle": width // 2, "end": width}[anchor]
    cv2.putText(image, text, (left, at[1]), _FONT, size, ink, thickness, cv2.LINE_AA)


def text_width(text: str, size: float, thickness: int = 2) -> int:
    """Width of a text, pixels."""
    return int(cv2.getTextSize(text, _FONT, size, thickness)[0][0])
