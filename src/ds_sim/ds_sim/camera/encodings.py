# SPDX-License-Identifier: Apache-2.0
"""Encodings of pictures: PNG of charts and maps, JPEG of camera images in data sets and bags."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def png(image: NDArray[np.uint8]) -> bytes:
    """Encode an RGB picture as PNG; the same pixels give the same bytes.

    Args:
        image: (rows, columns, 3) uint8 RGB.

    Raises:
        ValueError: OpenCV cannot encode it.
    """
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise ValueError(f"a picture of shape {image.shape} cannot be encoded: expected (rows, columns, 3) uint8")
    return bytes(data.tobytes())


JPEG_QUALITY = 95
"""Chosen: 20 to 30 kB per image, errors below the noise of the cameras."""


def jpeg(image: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """Encode an RGB image as JPEG.

    Args:
        image: (rows, columns, 3) uint8 RGB.
        quality: 0 to 100.

    Raises:
        ValueError: OpenCV cannot encode the image.
    """
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded as JPEG")
    return bytes(data.tobytes())
