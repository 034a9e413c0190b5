"""PNG encoding of pictures, the one that every chart and map is written with."""

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
