# SPDX-License-Identifier: Apache-2.0
"""Messages of the Donkey simulator's protocol: framing, parsing, and telemetry."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_base.bounded_file import FileError, load_json
from ds_base.errors import InputError
from ds_sim.camera.encodings import jpeg, png
from ds_sim.simulator import Command, Observation, Outcome

LARGEST_MESSAGE = 64 * 1024
"""Bytes of a message; chosen: gym-donkeycar's longest has some 300."""
_SPACE = b" \t\r\n\0"


class ProtocolError(InputError):
    """A client sent what the protocol does not allow; its session ends."""


class MessageSplitter:
    """Collects bytes as they come, and finds the end of each object by its braces."""

    def __init__(self) -> None:
        self._pending = bytearray()
        self._looked_at = 0
        self._depth = 0
        self._in_text = False
        self._escaped = False

    def feed(self, data: bytes) -> list[dict[str, Any]]:
        """Take bytes, and return the messages that are now complete, each with a text `msg_type`.

        ProtocolError if the bytes are no JSON objects, or one is longer than `LARGEST_MESSAGE`.
        """
        self._pending += data
        messages = []
        while (end := self._end_of_object()) is not None:
            messages.append(_parse(bytes(self._pending[:end])))
            del self._pending[:end]
            self._looked_at = 0
        if len(self._pending) > LARGEST_MESSAGE:
            raise ProtocolError(f"a message has more than {LARGEST_MESSAGE} bytes: expected one short JSON object")
        return messages

    def _end_of_object(self) -> int | None:
        """Position after the first object, or None if it is not complete."""
        for position in range(self._looked_at, len(self._pending)):
            byte = self._pending[position]
            if self._depth == 0 and byte not in _SPACE and byte != ord("{"):
                raise ProtocolError(f"a message begins with {chr(byte)!r}: expected a JSON object")
            if self._in_text:
                self._in_text = self._escaped or byte != ord('"')
                self._escaped = byte == ord("\\") and not self._escaped
            elif byte == ord('"'):
                self._in_text = True
            elif byte == ord("{"):
                self._depth += 1
            elif byte == ord("}"):
                self._depth -= 1
                if self._depth == 0:
                    return position + 1
        self._looked_at = len(self._pending)
        return None


def _parse(text: bytes) -> dict[str, Any]:
    try:
        message = load_json(text)
    except FileError as error:
        raise ProtocolError(f"a message is {error}") from None
    if not isinstance(message, dict) or not isinstance(message.get("msg_type"), str):
        raise ProtocolError("a message has no msg_type: expected such as control")
    return message


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
    """How images are sent: as `JPG`, or as lossless `PNG`, also for `TGA`; grey as three equal channels."""

    width: int = DEFAULT_WIDTH
    height: int = DEFAULT_HEIGHT
    encoding: str = "JPG"
    grey: bool = False


def command_of(message: dict[str, Any]) -> tuple[Command, float]:
    """Read a `control`: the command, clipped to its range, and the brake, 0 to 1.

    There is no throttle while the brake is on: the vehicles drive forward only and have no other brake.
    """
    steering = min(max(number_in(message, "steering"), -1.0), 1.0)
    throttle = min(max(number_in(message, "throttle"), 0.0), 1.0)
    brake = min(max(number_in(message, "brake", 0.0), 0.0), 1.0)
    return Command(steering, 0.0 if brake > 0 else throttle), brake


def image_format_of(message: dict[str, Any], current: ImageFormat) -> ImageFormat:
    """Read a `cam_config`; a value of 0 keeps the current one."""
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
    """Read a number, given as such or as text; ProtocolError if it is missing without a default, or not finite."""
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


NO_HIT = "none"
"""`hit` as long as nothing was hit; gym-donkeycar ends the episode at any other text."""
_LUMA = np.array([[0.2126, 0.7152, 0.0722]] * 3)
"""Weights of the grey image (sdsandbox's camera sensor; Rec. 709)."""


def telemetry(frame: Observation, command: Command, form: ImageFormat) -> dict[str, Any]:
    """Message with the frame after a `control`, and its command.

    `hit` is `none`, or how the run ended in lower case, `completed` included; `cte` is the lateral position, m,
    positive to the right, as in sdsandbox.
    """
    vehicle = frame.vehicle
    return {
        "msg_type": "telemetry",
        "steering_angle": command.steering,
        "throttle": command.throttle,
        "speed": math.hypot(vehicle.speed, vehicle.lateral_speed),
        "image": base64.b64encode(encoded(frame.image, form)).decode("ascii"),
        "hit": NO_HIT if frame.outcome is Outcome.RUNNING else frame.outcome.name.lower(),
        "time": frame.time,
        "pos_x": vehicle.x,
        "pos_y": vehicle.heave,
        "pos_z": vehicle.y,
        "vel_x": -vehicle.lateral_speed,
        "vel_y": 0.0,
        "vel_z": vehicle.speed,
        "pitch": math.degrees(vehicle.pitch) % 360.0,
        "yaw": (90.0 - math.degrees(vehicle.yaw)) % 360.0,
        "roll": -math.degrees(vehicle.roll) % 360.0,
        "cte": frame.lane.lateral_position,
    }


def encoded(image: NDArray[np.uint8], form: ImageFormat) -> bytes:
    """Scale and encode an image, (rows, columns, 3) uint8 RGB; one of the camera's own size as PNG keeps every bit."""
    if image.shape[:2] != (form.height, form.width):
        image = np.asarray(cv2.resize(image, (form.width, form.height), interpolation=cv2.INTER_AREA), np.uint8)
    if form.grey:
        image = np.asarray(cv2.transform(image, _LUMA), np.uint8)
    return jpeg(image) if form.encoding == "JPG" else png(image)
