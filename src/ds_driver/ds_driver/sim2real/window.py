"""Cuts what a generator sees out of an image: the same function for training data and for driving."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

MIN_SIDE = 8
"""Fewest rows and columns of a window, px; chosen: less than a lane line is wide near the car."""


class Sim2RealError(ValueError):
    """Photographs, generators or settings that cannot be used."""


@dataclass(frozen=True, slots=True)
class Window:
    """Part of an image that is shown to a generator, px of that image.

    Attributes:
        top: first row.
        bottom: end of the rows.
        left: first column.
        right: end of the columns.
    """

    top: int
    bottom: int
    left: int
    right: int

    def __post_init__(self) -> None:
        if min(self.top, self.left) < 0 or self.bottom - self.top < MIN_SIDE or self.right - self.left < MIN_SIDE:
            raise Sim2RealError(f"crop {self}: expected at least {MIN_SIDE} rows and columns, none of them negative")

    def __str__(self) -> str:
        return f"rows {self.top} to {self.bottom}, columns {self.left} to {self.right}"


def prepare(image: NDArray[np.uint8], window: Window, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Cut out a window and resize it, without state and without chance.

    Args:
        image: (rows, columns, 3) uint8 RGB.
        window: part to cut out.
        size: rows and columns of the result.

    Returns:
        (*size, 3) uint8 RGB.

    Raises:
        Sim2RealError: the image does not have the window, or is not uint8 RGB.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise Sim2RealError(f"image of shape {image.shape} and type {image.dtype}, expected (rows, columns, 3) uint8")
    if window.bottom > image.shape[0] or window.right > image.shape[1]:
        raise Sim2RealError(
            f"image of {image.shape[0]} x {image.shape[1]} px, expected one with {window}: it comes from another camera"
        )
    part = image[window.top : window.bottom, window.left : window.right]
    return resize(part, size)


def resize(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize to rows and columns: by areas where the image shrinks in both directions, else bilinearly."""
    rows, columns = image.shape[:2]
    if (rows, columns) == size:
        return np.ascontiguousarray(image)
    method = cv2.INTER_AREA if rows >= size[0] and columns >= size[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=method), np.uint8)
