"""Draws steering errors: density per group, steering over time, and the images with the largest errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ds_analysis.common.chart import COLOURS, LEFT, WIDTH, Chart, Picture, write
from ds_analysis.common.statistics import Array
from ds_analysis.paper.open_loop import Answers
from ds_analysis.paper.steering_error_stats import EDGES, density, pooled_errors
from ds_sim.camera.encodings import png

SHOWN = 4
"""Largest number of recordings drawn over time; chosen: fits on a screen."""
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
    picture = np.full((40, WIDTH, 3), 255, np.uint8)
    write(picture, title, (LEFT, 28), 0.7)
    return picture


def _densities(errors: dict[str, Array]) -> Picture:
    together = np.concatenate(list(errors.values()))
    # Shows 99.5 % of the errors; the table has the largest one.
    reach = float(np.clip(1.2 * np.quantile(np.abs(together), 0.995), 0.1, 2.0))
    curves = {group: density(values) for group, values in errors.items()}
    highest = max(float(curve.max()) for curve in curves.values())
    chart = Chart(
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
    chart = Chart(title, "image", (float(number[0]), float(number[-1])), (-1.05, 1.05), 230)
    chart.line(number[[0, -1]], np.zeros(2), (150, 150, 150), 1)
    chart.line(number, answers.recorded, (0, 0, 0), 2)
    chart.line(number, answers.answered, COLOURS[1], 1)
    chart.note("recorded", 0, (0, 0, 0), across=True)
    chart.note("answered", 1, COLOURS[1], across=True)
    return chart.image


def _worst(answers: Answers) -> Picture:
    """Draw the images with the largest errors, with both steerings as needles: black recorded, red answered."""
    picture = np.full((_THUMB[1] + 62, WIDTH, 3), 255, np.uint8)
    write(picture, f"Largest errors in {answers.name}: black recorded, red answered", (LEFT, 20), 0.5)
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
        write(picture, text, (left + 4, 30 + _THUMB[1] + 18), 0.42)
    return picture
