# SPDX-License-Identifier: Apache-2.0
"""Encodings of pictures: PNG of charts and maps, JPEG of camera images in data sets and bags."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

JPEG_QUALITY = 95
"""Chosen: 20 to 30 kB per image, errors below the noise of the cameras."""


def png(image: NDArray[np.uint8]) -> bytes:
    """Encode a picture, (rows, columns, 3) uint8 RGB, as PNG; ValueError if it is too wide or too high for OpenCV."""
    return _encoded(image, ".png")


def jpeg(image: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """Encode an image, (rows, columns, 3) uint8 RGB, as JPEG of a quality from 0 to 100; errors as in `png`."""
    return _encoded(image, ".jpg", cv2.IMWRITE_JPEG_QUALITY, quality)


def _encoded(image: NDArray[np.uint8], suffix: str, *parameters: int) -> bytes:
    done, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)
    if not done:
        raise ValueError(f"a picture of shape {image.shape} cannot be encoded as {suffix}")
    return bytes(data.tobytes())
