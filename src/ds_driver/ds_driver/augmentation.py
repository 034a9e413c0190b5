"""Changes to training images that leave the steering as it is (maxitwo; brightness without its overflow)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def augment(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Half of the images get a shadow, a change of brightness, or both; (160, 320, 3) uint8 RGB in and out."""
    if rng.random() < 0.5:
        return image
    if rng.random() < 0.5:
        image = _shadow(image, rng)
    if rng.random() < 0.5:
        image = cv2.convertScaleAbs(image, alpha=float(rng.uniform(0.8, 1.2)))
    return image


def _shadow(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Darken one side of a random line to 0.2 to 0.5 (maxitwo)."""
    rows, columns = image.shape[:2]
    top, bottom = rng.integers(0, columns, 2)
    side = 0 if rng.random() < 0.5 else columns
    mask = np.zeros((rows, columns), np.uint8)
    cv2.fillPoly(mask, [np.array([[top, 0], [bottom, rows], [side, rows], [side, 0]], np.int32)], 255)
    dark = cv2.convertScaleAbs(image, alpha=float(rng.uniform(0.2, 0.5)))
    return np.where(mask[:, :, None] > 0, dark, image)
