"""Images of any camera as RGB pixels: the encodings of sensor_msgs/Image, and compressed ones. No ROS.

Source: sensor_msgs/include/sensor_msgs/image_encodings.hpp of common_interfaces 5.3; `yuv422` there is UYVY.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_driver.preprocessing import ImageError
from ds_sim.camera_spec import IMAGE_HEIGHT, IMAGE_WIDTH


@dataclass(frozen=True)
class _Encoding:
    channels: int
    to_rgb: int | None


ENCODINGS = {
    "rgb8": _Encoding(3, None),
    "bgr8": _Encoding(3, cv2.COLOR_BGR2RGB),
    "rgba8": _Encoding(4, cv2.COLOR_RGBA2RGB),
    "bgra8": _Encoding(4, cv2.COLOR_BGRA2RGB),
    "mono8": _Encoding(1, cv2.COLOR_GRAY2RGB),
    "8UC1": _Encoding(1, cv2.COLOR_GRAY2RGB),
    "8UC3": _Encoding(3, cv2.COLOR_BGR2RGB),
    "yuv422": _Encoding(2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": _Encoding(2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": _Encoding(2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": _Encoding(2, cv2.COLOR_YUV2RGB_YUY2),
}
"""Bytes of a pixel, and OpenCV's way to RGB. The values without a colour order (8UC3) are BGR, as OpenCV writes them."""


def decode(encoding: str, height: int, width: int, step: int, data: bytes) -> NDArray[np.uint8]:
    """The pixels of a sensor_msgs/Image.

    Args:
        encoding: as the message says.
        height: rows.
        width: columns.
        step: bytes of a row, padding included; 0 for none.
        data: rows one after the other.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        ImageError: an unknown encoding, or another number of bytes than the size asks for.
    """
    known = ENCODINGS.get(encoding)
    if known is None:
        raise ImageError(f"image of encoding {encoding!r}: expected one of {', '.join(ENCODINGS)}")
    row = width * known.channels
    step = step or row
    if min(height, width) < 1 or step < row or len(data) < step * (height - 1) + row:
        raise ImageError(
            f"image of {width} x {height} px in {encoding} with rows of {step} bytes and {len(data)} bytes in all: "
            f"expected rows of at least {row} bytes and {row * height} bytes"
        )
    if known.channels == 2 and width % 2:
        raise ImageError(f"image of {width} px width in {encoding}: two pixels share their colour, expected an even width")
    flat = np.frombuffer(data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(flat, (height, row), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).reshape(height, width, known.channels)
    return pixels if known.to_rgb is None else cv2.cvtColor(pixels, known.to_rgb)


def decompress(data: bytes) -> NDArray[np.uint8]:
    """The pixels of a sensor_msgs/CompressedImage: JPEG, PNG or whatever else OpenCV reads.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        ImageError: nothing that can be read.
    """
    encoded = np.frombuffer(data, np.uint8)
    image = cv2.imdecode(encoded, cv2.IMREAD_COLOR) if encoded.size else None
    if image is None:
        raise ImageError(f"compressed image of {len(data)} bytes cannot be read: expected JPEG or PNG")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def to_network_size(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image of any size as (160, 320, 3): the middle part of the network's aspect ratio, made smaller or larger.

    What is cut off to get twice as wide as high is cut at the top and bottom, or at both sides, in equal parts.

    Args:
        image: (rows, columns, 3) uint8 RGB.
    """
    rows, columns = image.shape[:2]
    if (rows, columns) == (IMAGE_HEIGHT, IMAGE_WIDTH):
        return image
    height = min(rows, max(1, round(columns * IMAGE_HEIGHT / IMAGE_WIDTH)))
    width = min(columns, max(1, round(rows * IMAGE_WIDTH / IMAGE_HEIGHT)))
    top, left = (rows - height) // 2, (columns - width) // 2
    part = image[top : top + height, left : left + width]
    way = cv2.INTER_AREA if height > IMAGE_HEIGHT else cv2.INTER_LINEAR
    return cv2.resize(part, (IMAGE_WIDTH, IMAGE_HEIGHT), interpolation=way)
