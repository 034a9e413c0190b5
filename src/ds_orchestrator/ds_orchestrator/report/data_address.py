"""Pictures inside a page, as `data:` addresses (RFC 2397)."""

from __future__ import annotations

import base64

import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.png import png


def data_address(picture: NDArray[np.uint8]) -> str:
    """Encode an RGB picture, (rows, columns, 3) uint8, as the address of a PNG."""
    return f"data:image/png;base64,{base64.b64encode(png(picture)).decode()}"
