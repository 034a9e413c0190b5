"""Telemetry: one frame in the units and axes of the Donkey simulator's clients.

Unity's axes are left-handed: x right, y up, z forward. The road frame's x and y become x and z. Velocities are along
the vehicle's axes, which is what gym-donkeycar's `forward_vel` expects: for small pitch and roll it equals `vel_z`.
Lengths are metres of the road, where the Donkey simulator divides its own by 8.
"""

from __future__ import annotations

import base64
import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera import jpeg
from ds_sim.camera.png import png
from ds_sim.donkey_protocol.messages import ImageFormat
from ds_sim.simulator import Command, Observation, Outcome

NO_HIT = "none"
"""`hit` as long as nothing was hit; gym-donkeycar ends the episode at any other text."""
_LUMA = np.array([[0.2126, 0.7152, 0.0722]] * 3)
"""Weights of the grey image (sdsandbox's camera sensor; Rec. 709)."""


def telemetry(frame: Observation, command: Command, form: ImageFormat) -> dict[str, Any]:
    """Message that answers a `control`.

    Args:
        frame: frame after the control.
        command: that led to it.
        form: of the image.

    Returns:
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
    """Scale and encode an image; one of the camera's own size as PNG keeps every bit.

    Args:
        image: (rows, columns, 3) uint8 RGB.
        form: asked for by the client.
    """
    if image.shape[:2] != (form.height, form.width):
        image = np.asarray(cv2.resize(image, (form.width, form.height), interpolation=cv2.INTER_AREA), np.uint8)
    if form.grey:
        image = np.asarray(cv2.transform(image, _LUMA), np.uint8)
    return jpeg.encode(image) if form.encoding == "JPG" else png(image)
