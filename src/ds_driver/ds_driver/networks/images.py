# SPDX-License-Identifier: Apache-2.0
"""Decodes camera images, fits them to the networks' size, and prepares them for networks (paper 3.2.2)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_file import FileError, read_regular
from ds_base.errors import InputError
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.simulator import SimulatorSpec

Pixels = NDArray[np.uint8]
MAX_PIXELS = 2**26
"""Largest number of pixels of an image; chosen: 8192 x 8192, more than any vehicle camera has."""
MAX_IMAGE_FILE = 64 * 2**20
"""Largest file of an image, bytes."""
_TO_RGB: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    # OpenCV names the second and third pixel of the second row, ROS the first two of the first.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
    "nv12": (1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (1, cv2.COLOR_YUV2RGB_NV21),
}
"""sensor_msgs/image_encodings -> bytes per pixel and OpenCV conversion; `yuv422` means UYVY."""
_SIXTEEN_BITS = {
    "mono16": "mono8",
    "16UC1": "mono8",
    "rgb16": "rgb8",
    "bgr16": "bgr8",
    **{f"bayer_{pattern}16": f"bayer_{pattern}8" for pattern in ("rggb", "bggr", "gbrg", "grbg")},
}
"""Encodings of 16 bits -> those of their upper 8 bits."""


class ImageError(InputError):
    """The image has a size, type or content that the networks do not accept."""


@dataclass(frozen=True, slots=True)
class Crop:
    """Image rows hidden from a network: the `top` above the horizon, and the `bottom` with the front of the vehicle."""

    top: int = 0
    bottom: int = 0

    def __post_init__(self) -> None:
        if self.top < 0 or self.bottom < 0 or self.top + self.bottom > IMAGE_HEIGHT - 8:
            raise ImageError(
                f"crop of {self.top} rows at the top and {self.bottom} at the bottom leaves nothing to see: "
                f"expected at most {IMAGE_HEIGHT - 8} rows together"
            )

    @classmethod
    def of(cls, spec: SimulatorSpec) -> Crop:
        """Return the rows of a simulator's images that the paper's networks do not see."""
        return cls(spec.crop_top, spec.crop_bottom)


def prepare(image: NDArray[np.uint8], crop: Crop) -> NDArray[np.uint8]:
    """Crop (160, 320, 3) uint8 RGB, resize it back and convert it to YUV (order and colour space as in maxitwo).

    Raises:
        ImageError: the image has another size or type.

    Examples:
        >>> from ds_driver import Crop, Frame, prepare
        >>> prepare(Frame.black().image, Crop(top=60, bottom=20)).shape
        (160, 320, 3)
    """
    checked(image)
    part = image[crop.top : IMAGE_HEIGHT - crop.bottom]
    if part.shape[0] != IMAGE_HEIGHT:
        part = cv2.resize(part, (IMAGE_WIDTH, IMAGE_HEIGHT), interpolation=cv2.INTER_LINEAR)
    return cv2.cvtColor(part, cv2.COLOR_RGB2YUV)


def checked(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a camera image; an ImageError if its size or type is another than (160, 320, 3) uint8."""
    if image.shape != (IMAGE_HEIGHT, IMAGE_WIDTH, 3) or image.dtype != np.uint8:
        raise ImageError(
            f"image of shape {image.shape} and type {image.dtype}, "
            f"expected ({IMAGE_HEIGHT}, {IMAGE_WIDTH}, 3) uint8 RGB: set the camera to 320 x 160"
        )
    return image


def rgb_of(data: Pixels, *, encoding: str, height: int, width: int, step: int, big_endian: bool = False) -> Pixels:
    """Convert the (n,) bytes of a `sensor_msgs/Image` to (height, width, 3) uint8 RGB; of 16 bits the upper 8.

    Rows are `step` bytes apart, without padding if that is 0. An unknown encoding, or sizes that do not match the data
    or the encoding, are an ImageError.
    """
    if encoding in _SIXTEEN_BITS:
        data = data[0 if big_endian else 1 :: 2]
        return rgb_of(data, encoding=_SIXTEEN_BITS[encoding], height=height, width=width, step=step // 2)
    if encoding not in _TO_RGB:
        raise ImageError(f"image of encoding {encoding!r}, expected one of {', '.join((*_TO_RGB, *_SIXTEEN_BITS))}")
    channels, conversion = _TO_RGB[encoding]
    step = step or width * channels
    if encoding.startswith(("nv", "bayer")) and (width % 2 or height % 2):
        raise ImageError(f"image of {width} x {height} px: {encoding} needs an even width and height")
    if encoding.startswith("nv"):
        height += height // 2  # rows of colour below those of brightness
    if height < 1 or width < 1 or step < width * channels or data.size < height * step:
        raise ImageError(f"image of {width} x {height} px, {step} bytes a row and {data.size} bytes: does not fit")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, : width * channels])
    image = rows.reshape(height, width, channels) if channels > 1 else rows
    if channels == 2 and width % 2:
        raise ImageError(f"image of {width} x {height} px: {encoding} needs an even width")
    return image if conversion is None else np.asarray(cv2.cvtColor(image, conversion), np.uint8)


def rgb_of_message(message: Any) -> Pixels:
    """Convert a `sensor_msgs/Image` or `CompressedImage`, of rclpy or rosbags, with `rgb_of` or `rgb_of_file`."""
    data = np.frombuffer(message.data, np.uint8)
    if hasattr(message, "format"):
        return rgb_of_file(data.tobytes())
    return rgb_of(
        data,
        encoding=message.encoding,
        height=message.height,
        width=message.width,
        step=message.step,
        big_endian=bool(getattr(message, "is_bigendian", False)),
    )


def rgb_of_file(data: bytes) -> Pixels:
    """Decode a JPEG or PNG to (height, width, 3) uint8 RGB; an ImageError if damaged, or of more than `MAX_PIXELS`."""
    size = _declared_size(data)
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise ImageError(f"an image of {size[0]} x {size[1]} px: the limit is {MAX_PIXELS} pixels")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if size is not None else None
    except cv2.error:
        image = None
    if image is None:
        raise ImageError("an image is damaged, or neither JPEG nor PNG")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_rgb(path: Path) -> Pixels:
    """Read a file as `rgb_of_file` decodes it; an ImageError if it is missing or larger than `MAX_IMAGE_FILE`, too."""
    try:
        return rgb_of_file(read_regular(path, MAX_IMAGE_FILE))
    except (OSError, FileError) as error:
        raise ImageError(getattr(error, "strerror", None) or str(error)) from None


def _declared_size(data: bytes) -> tuple[int, int] | None:
    """Read width and height from the header of a JPEG or PNG, before decoding; None for other formats."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            at = data.find(b"\xff", at)
            if at < 0:
                return None
            continue
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD8:
            at += 1 if marker == 0xFF else 2
        else:
            at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
    return None


def part_for_network(width: int, height: int) -> tuple[slice, slice]:
    """Rows and columns that a network sees: the lower part of an image taller than 1:2, the middle of a wider one."""
    rows, columns = max(1, width * IMAGE_HEIGHT // IMAGE_WIDTH), max(1, height * IMAGE_WIDTH // IMAGE_HEIGHT)
    rows, columns = min(rows, height), min(columns, width)
    left = (width - columns) // 2
    return slice(height - rows, height), slice(left, left + columns)


def fit_to_network(image: Pixels, rows: tuple[int, int] | None = None) -> Pixels:
    """Crop and resize an image, (rows, columns, 3) uint8 RGB, to (160, 320, 3).

    `rows` are the first one to keep and the one after the last, from the top; an ImageError if it does not have them.
    Without them the aspect ratio is kept: see `part_for_network`.
    """
    height, width = image.shape[:2]
    if rows is not None:
        if not 0 <= rows[0] < rows[1] <= height:
            raise ImageError(f"rows {rows[0]} to {rows[1]} of an image of {height}: expected 0 to {height} at most")
        image = image[rows[0] : rows[1]]
    else:
        image = image[part_for_network(width, height)]
    if image.shape[:2] == (IMAGE_HEIGHT, IMAGE_WIDTH):
        return image
    method = cv2.INTER_AREA if image.shape[0] > IMAGE_HEIGHT else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (IMAGE_WIDTH, IMAGE_HEIGHT), interpolation=method), np.uint8)
