"""Converts camera images to network inputs, in training and in driving alike (paper 3.2.2)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH


class ImageError(ValueError):
    """The image has a size, type or content that the networks do not accept."""


@dataclass(frozen=True, slots=True)
class Crop:
    """Image rows hidden from a network: those above the horizon, and the front of the vehicle.

    Attributes:
        top: rows cut off at the top.
        bottom: rows cut off at the bottom.
    """

    top: int = 0
    bottom: int = 0

    def __post_init__(self) -> None:
        if self.top < 0 or self.bottom < 0 or self.top + self.bottom > IMAGE_HEIGHT - 8:
            raise ImageError(
                f"crop of {self.top} rows at the top and {self.bottom} at the bottom leaves nothing to see: "
                f"expected at most {IMAGE_HEIGHT - 8} rows together"
            )


def prepare(image: NDArray[np.uint8], crop: Crop) -> NDArray[np.uint8]:
    """Crop, resize to 160 x 320 and convert to YUV (order and colour space as in maxitwo).

    Args:
        image: (160, 320, 3) uint8 RGB.
        crop: rows to cut off.

    Returns:
        (160, 320, 3) uint8 YUV.

    Raises:
        ImageError: the image has another size or type.

    Examples:
        >>> import numpy as np
        >>> from ds_driver import Crop, prepare
        >>> image = np.zeros((160, 320, 3), np.uint8)
        >>> prepare(image, Crop(top=60, bottom=20)).shape
        (160, 320, 3)
    """
    checked(image)
    part = image[crop.top : IMAGE_HEIGHT - crop.bottom]
    if part.shape[0] != IMAGE_HEIGHT:
        part = cv2.resize(part, (IMAGE_WIDTH, IMAGE_HEIGHT), interpolation=cv2.INTER_LINEAR)
    return cv2.cvtColor(part, cv2.COLOR_RGB2YUV)


def checked(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Check the size and type of a camera image, and return it.

    Raises:
        ImageError: the image has another size or type.
    """
    if image.shape != (IMAGE_HEIGHT, IMAGE_WIDTH, 3) or image.dtype != np.uint8:
        raise ImageError(
            f"image of shape {image.shape} and type {image.dtype}, "
            f"expected ({IMAGE_HEIGHT}, {IMAGE_WIDTH}, 3) uint8 RGB: set the camera to 320 x 160"
        )
    return image
