# SPDX-License-Identifier: Apache-2.0
"""Text on pictures drawn with OpenCV, such as maps of cells and drawings of roads."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
Rgb = tuple[int, int, int]
INK: Rgb = (30, 30, 30)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


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
