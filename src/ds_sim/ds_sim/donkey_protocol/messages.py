"""Values in a client's messages; the Donkey simulator's clients send every number as text."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ds_sim.donkey_protocol.framing import ProtocolError
from ds_sim.simulator import Command

DEFAULT_WIDTH = 160
DEFAULT_HEIGHT = 120
"""Pixels of an image unless the client asks for others (`cam_resolution` of gym-donkeycar's environments)."""
LARGEST_SIDE = 1024
"""Pixels; chosen: three times our cameras' width."""
ENCODINGS = ("JPG", "PNG", "TGA")
FIXED_CAMERA_FIELDS = (
    "fov", "fish_eye_x", "fish_eye_y", "offset_x", "offset_y", "offset_z", "rot_x", "rot_y", "rot_z",
)  # fmt: skip
"""What else a client may ask of the camera; here each simulator has a camera of its own."""


@dataclass(frozen=True)
class ImageFormat:
    """How images are sent.

    Attributes:
        width: px.
        height: px.
        encoding: `JPG`; or `PNG`, which is lossless and also sent for `TGA`.
        grey: three equal channels.
    """

    width: int = DEFAULT_WIDTH
    height: int = DEFAULT_HEIGHT
    encoding: str = "JPG"
    grey: bool = False


def command_of(message: dict[str, Any]) -> tuple[Command, float]:
    """Read a `control`.

    Returns:
        Command, clipped to its range, with no throttle while the brake is on: the vehicles drive forward only and have
        no other brake; and the brake, 0 to 1.

    Raises:
        ProtocolError: a value is missing or not a number.
    """
    steering = min(max(number_in(message, "steering"), -1.0), 1.0)
    throttle = min(max(number_in(message, "throttle"), 0.0), 1.0)
    brake = min(max(number_in(message, "brake", 0.0), 0.0), 1.0)
    return Command(steering, 0.0 if brake > 0 else throttle), brake


def image_format_of(message: dict[str, Any], current: ImageFormat) -> ImageFormat:
    """Read a `cam_config`; a value of 0 keeps the current one.

    Raises:
        ProtocolError: an image like this cannot be sent.
    """
    width, height = (number_in(message, side, 0.0) for side in ("img_w", "img_h"))
    depth = number_in(message, "img_d", 0.0)
    for name, value in (("img_w", width), ("img_h", height)):
        if not (0 <= value <= LARGEST_SIDE and value == int(value)):
            raise ProtocolError(f"{name} is {value:g}: expected a whole number of pixels up to {LARGEST_SIDE}")
    if depth not in (0, 1, 3):
        raise ProtocolError(f"img_d is {depth:g}: expected 1 or 3")
    encoding = str(message.get("img_enc", "0"))
    if encoding not in (*ENCODINGS, "0", ""):
        raise ProtocolError(f"img_enc is {encoding[:20]!r}: expected one of {', '.join(ENCODINGS)}")
    return ImageFormat(
        width=int(width) or current.width,
        height=int(height) or current.height,
        encoding=encoding if encoding in ENCODINGS else current.encoding,
        grey=depth == 1 if depth else current.grey,
    )


def number_in(message: dict[str, Any], name: str, default: float | None = None) -> float:
    """A number, given as such or as text.

    Raises:
        ProtocolError: it is missing without a default, or not a finite number.
    """
    value = message.get(name, default)
    try:
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise ValueError
        number = float(value)
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ProtocolError(f"{message['msg_type'][:30]}: {name} is {str(value)[:30]!r}, expected a number")
    return number
