"""Draws how much of each condition a driver withstands: a tornado chart, the most sensitive condition on top."""

from __future__ import annotations

import cv2
import numpy as np

from ds_analysis.common.chart import COLOURS, WIDTH, Picture, write
from ds_studies.sensitivity.analysis import Sensitivity
from ds_studies.sensitivity.factors import LEVELS
from ds_studies.sensitivity.measurement import Threshold

_LEFT, _RIGHT, _HEAD, _FOOT, _BAR, _GAP = 250, 150, 92, 46, 13, 10
_FAINT, _INK = (222, 222, 222), (40, 40, 40)


def draw_sensitivity(found: Sensitivity) -> Picture:
    """Draw one group of bars for each factor, one bar for each simulator.

    A bar reaches to the strength at which the median road fails; a thin line spans the roads. A hollow bar has no
    failure in its end: hollow to the hardest value, or to where no driver can be judged.

    Returns:
        (rows, columns, 3) uint8 RGB.
    """
    group = _BAR * len(found.simulators) + _GAP
    image = np.full((_HEAD + group * len(found.factors) + _FOOT, WIDTH, 3), 255, np.uint8)
    write(image, f"Strength at which {found.driver} first fails; hollow: no failure", (16, 24), 0.55)
    for index, name in enumerate(found.simulators):
        x, colour = 16 + 180 * index, COLOURS[index % len(COLOURS)]
        cv2.rectangle(image, (x, 42), (x + 18, 52), colour, -1)
        write(image, name if len(name) <= 16 else f"{name[:7]}..{name[-7:]}", (x + 26, 52), 0.45)
    for tenth in range(0, 11, 2):
        x = _x(tenth / 10)
        cv2.line(image, (x, _HEAD - 8), (x, image.shape[0] - _FOOT), _FAINT, 1)
        write(image, f"{tenth * 10} %", (x - 12, image.shape[0] - _FOOT + 18), 0.42)
    write(image, "share of the condition's range", (_LEFT, image.shape[0] - 8), 0.45)
    for row, position in enumerate(found.order):
        top = _HEAD + group * row
        write(image, found.factors[position].title, (8, top + (group - _GAP) // 2 + 5), 0.42)
        for index, name in enumerate(found.simulators):
            colour = COLOURS[index % len(COLOURS)]
            _draw_bar(image, found.thresholds[position, name], top + _BAR * index, colour)
    return image


def _draw_bar(image: Picture, one: Threshold, top: int, colour: tuple[int, int, int]) -> None:
    middle, bottom = top + _BAR // 2, top + _BAR - 3
    if one.withstood is None:
        write(image, one.verdict, (_LEFT + 4, bottom), 0.36)
        return
    end = _x(one.withstood)
    cv2.rectangle(image, (_LEFT, top), (end, bottom), colour, -1 if one.verdict == "fails" else 1)
    first, last = (_x((level or LEVELS) / LEVELS) for level in one.interval)
    if one.verdict == "fails":
        cv2.line(image, (first, middle), (last, middle), _INK, 1)
    write(image, one.text, (max(end, last if one.verdict == "fails" else 0) + 6, bottom), 0.36)


def _x(share: float) -> int:
    return round(_LEFT + share * (WIDTH - _LEFT - _RIGHT))
