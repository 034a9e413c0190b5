"""Draws steering errors: density per group, steering over time, and the images with the largest errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_orchestrator.evaluation.open_loop import Answers
from ds_orchestrator.evaluation.steering_error_stats import EDGES, density, pooled_errors
from ds_sim.camera.png import png

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Rgb = tuple[int, int, int]
COLOURS: tuple[Rgb, ...] = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (150, 110, 0), (70, 70, 70))
"""Okabe and Ito's palette, safe for red-green colour blindness; repeats for further groups."""
SHOWN = 4
"""Largest number of recordings drawn over time; chosen: fits on a screen."""
_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 1140, 78, 24, 42, 52
_INK: Rgb = (40, 40, 40)
_FAINT: Rgb = (225, 225, 225)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
_THUMB = (190, 95)


def draw_errors(title: str, answers: Sequence[Answers], path: Path) -> None:
    """Write a picture of steering errors as PNG.

    Args:
        title: heading of the picture.
        answers: answers to every recording.
        path: path of the PNG file.
    """
    parts = [_heading(title)]
    errors = pooled_errors(answers)
    if errors:
        parts.append(_densities(errors))
    parts += [_over_time(one) for one in answers[:SHOWN] if len(one.index) > 1]
    worst = [_worst(one) for one in answers[:SHOWN] if one.worst]
    picture = np.vstack([*parts, *worst])
    path.write_bytes(png(picture))


def _heading(title: str) -> Picture:
    picture = np.full((40, _WIDTH, 3), 255, np.uint8)
    _write(picture, title, (_LEFT, 28), 0.7)
    return picture


def _densities(errors: dict[str, Array]) -> Picture:
    together = np.concatenate(list(errors.values()))
    # Shows 99.5 % of the errors; the table has the largest one.
    reach = float(np.clip(1.2 * np.quantile(np.abs(together), 0.995), 0.1, 2.0))
    curves = {group: density(values) for group, values in errors.items()}
    highest = max(float(curve.max()) for curve in curves.values())
    chart = _Chart(
        "Density of the steering errors",
        "answered minus recorded: left < 0 < right",
        (-reach, reach),
        (0.0, 1.1 * highest),
        330,
    )
    chart.line(np.array([0.0, 0.0]), np.array([0.0, 1.1 * highest]), (150, 150, 150), 1)
    for number, (group, curve) in enumerate(curves.items()):
        colour = COLOURS[number % len(COLOURS)]
        chart.line(np.repeat(EDGES, 2)[1:-1], np.repeat(curve, 2), colour, 2)
        text = f"{group}: mean size {np.abs(errors[group]).mean():.3f}, {errors[group].size} images"
        chart.note(text, number, colour)
    return chart.image


def _over_time(answers: Answers) -> Picture:
    """Draw steering over the image number, since a recording's clock may differ from the drive's."""
    number = answers.index.astype(np.float64)
    title = answers.name if answers.name == answers.group else f"{answers.name} ({answers.group})"
    chart = _Chart(title, "image", (float(number[0]), float(number[-1])), (-1.05, 1.05), 230)
    chart.line(number[[0, -1]], np.zeros(2), (150, 150, 150), 1)
    chart.line(number, answers.recorded, (0, 0, 0), 2)
    chart.line(number, answers.answered, COLOURS[1], 1)
    chart.note("recorded", 0, (0, 0, 0), across=True)
    chart.note("answered", 1, COLOURS[1], across=True)
    return chart.image


def _worst(answers: Answers) -> Picture:
    """Draw the images with the largest errors, with both steerings as needles: black recorded, red answered."""
    picture = np.full((_THUMB[1] + 62, _WIDTH, 3), 255, np.uint8)
    _write(picture, f"Largest errors in {answers.name}: black recorded, red answered", (_LEFT, 20), 0.5)
    for place, (frame, value) in enumerate(answers.worst):
        assert frame.image is not None and frame.steering is not None
        left = place * _THUMB[0]
        view = picture[30 : 30 + _THUMB[1], left : left + _THUMB[0] - 4]
        view[:] = cv2.resize(frame.image, (_THUMB[0] - 4, _THUMB[1]), interpolation=cv2.INTER_AREA)
        foot = (_THUMB[0] // 2, _THUMB[1] - 2)
        for steering, colour, width in (
            (frame.steering, (255, 255, 255), 5),
            (frame.steering, (0, 0, 0), 2),
            (value, (230, 40, 40), 2),
        ):
            turn = steering * np.pi / 3  # full lock is drawn 60 degrees to the side
            tip = (round(foot[0] + 60 * np.sin(turn)), round(foot[1] - 60 * np.cos(turn)))
            cv2.line(view, foot, tip, colour, width, cv2.LINE_AA)
        text = f"{frame.index}: {frame.steering:+.2f}, {value:+.2f}"
        _write(picture, text, (left + 4, 30 + _THUMB[1] + 18), 0.42)
    return picture


class _Chart:
    """Panel with axes."""

    def __init__(self, title: str, unit: str, x: tuple[float, float], y: tuple[float, float], height: int) -> None:
        self.image = np.full((height, _WIDTH, 3), 255, np.uint8)
        self._x, self._y = x, y
        self._size = np.array([_WIDTH - _LEFT - _RIGHT, height - _TOP - _BOTTOM], dtype=np.float64)
        self._corner = np.array([_LEFT, height - _BOTTOM], dtype=np.float64)
        _write(self.image, title, (_LEFT, 24), 0.55)
        for value in _ticks(*x):
            at = int(self._pixels(np.array([value]), np.array([y[0]]))[0, 0] / (1 << _SHIFT))
            cv2.line(self.image, (at, _TOP), (at, height - _BOTTOM), _FAINT, 1)
            _write(self.image, f"{value:g}", (at - 4 * len(f"{value:g}"), height - _BOTTOM + 18), 0.42)
        for value in _ticks(*y):
            at = int(self._pixels(np.array([x[0]]), np.array([value]))[0, 1] / (1 << _SHIFT))
            cv2.line(self.image, (_LEFT, at), (_WIDTH - _RIGHT, at), _FAINT, 1)
            _write(self.image, f"{value:g}", (_LEFT - 10 - 8 * len(f"{value:g}"), at + 5), 0.42)
        _write(self.image, unit, (_LEFT, height - 12), 0.45)

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

    def note(self, text: str, number: int, colour: Rgb, *, across: bool = False) -> None:
        """Write a line of the legend."""
        x = _WIDTH - _RIGHT - 220 + 110 * number if across else _LEFT + 14
        y = 24 if across else _TOP + 20 + 20 * number
        cv2.line(self.image, (x, y - 5), (x + 18, y - 5), colour, 3)
        _write(self.image, text, (x + 26, y), 0.45)


def _ticks(low: float, high: float) -> list[float]:
    """Choose four to nine round values between two limits."""
    rough = (high - low) / 6
    power = 10.0 ** np.floor(np.log10(rough))
    step = float(min(power * np.array([1.0, 2.0, 5.0, 10.0]), key=lambda s: abs(np.log(s / rough))))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [round(i * step, 10) for i in range(first, last + 1)]


def _write(image: Picture, text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(image, text, at, _FONT, size, _INK, 1, cv2.LINE_AA)
