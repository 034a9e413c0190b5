"""Augments training images as in the paper (maxitwo): flip, shift, shadow, brightness (without maxitwo's overflow)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_SHIFT = (50, 5)
"""Largest shift in columns and rows (maxitwo)."""
STEERING_PER_COLUMN = 0.002
"""Steering added per column of shift: the lane moves right, so the car must steer right (maxitwo)."""


def augment(image: NDArray[np.uint8], steering: float, rng: np.random.Generator) -> tuple[NDArray[np.uint8], float]:
    """Augment an image with probability one half, in up to four ways.

    Args:
        image: (160, 320, 3) uint8 RGB, before cropping.
        steering: label of the image in [-1, 1], -1 full left.
        rng: source of all random numbers.

    Returns:
        Image of the same shape, and its label in [-1, 1].
    """
    if rng.random() < 0.5:
        return image, steering
    if rng.random() < 0.5:
        image, steering = np.ascontiguousarray(image[:, ::-1]), -steering
    if rng.random() < 0.5:
        columns, rows = (int(rng.integers(-limit, limit + 1)) for limit in MAX_SHIFT)
        image = _shifted(image, columns, rows)
        steering = min(max(steering + STEERING_PER_COLUMN * columns, -1.0), 1.0)
    if rng.random() < 0.5:
        image = _shadow(image, rng)
    if rng.random() < 0.5:
        image = cv2.convertScaleAbs(image, alpha=float(rng.uniform(0.8, 1.2)))
    return image, steering


def _shifted(image: NDArray[np.uint8], columns: int, rows: int) -> NDArray[np.uint8]:
    """Shift an image right and down, filling with black (maxitwo)."""
    move = np.array([[1, 0, columns], [0, 1, rows]], np.float32)
    return cv2.warpAffine(image, move, (image.shape[1], image.shape[0]), flags=cv2.INTER_NEAREST)


def _shadow(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Darken one side of a random line to 0.2 to 0.5 of its brightness (maxitwo)."""
    rows, columns = image.shape[:2]
    top, bottom = rng.integers(0, columns, 2)
    side = 0 if rng.random() < 0.5 else columns
    mask = np.zeros((rows, columns), np.uint8)
    cv2.fillPoly(mask, [np.array([[top, 0], [bottom, rows], [side, rows], [side, 0]], np.int32)], 255)
    dark = cv2.convertScaleAbs(image, alpha=float(rng.uniform(0.2, 0.5)))
    return np.where(mask[:, :, None] > 0, dark, image)
