"""Linear light: decoding of pixel values by the sRGB curve (IEC 61966-2-1), in which contrast and stray light add."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_STEPS = 4096
"""Steps in which linear light is encoded; chosen: the darkest ones are 0.8 grey levels apart."""


def _decoded(levels: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def _encoded(light: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)


_TO_LIGHT = _decoded(np.arange(256) / 255.0).astype(np.float32)
_TO_LEVEL = np.rint(255.0 * _encoded(np.arange(_STEPS) / (_STEPS - 1.0))).astype(np.uint8)


def decode(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear light of pixels, 0 to 1 (a white surface in the reference illuminance), same shape."""
    return np.asarray(cv2.LUT(np.ascontiguousarray(pixels), _TO_LIGHT), np.float32).reshape(pixels.shape)


def encode(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Pixels of linear light, clipped to 0 to 1; changes `light`."""
    light *= np.float32(_STEPS - 1)
    light += np.float32(0.5)
    np.clip(light, 0.0, _STEPS - 1, out=light)
    return _TO_LEVEL[light.astype(np.uint16)]


def light_of(colour: tuple[int, int, int]) -> NDArray[np.float32]:
    """Linear light of a colour, (3,)."""
    return decode(np.array(colour, np.uint8).reshape(1, 1, 3)).reshape(3)
