# SPDX-License-Identifier: Apache-2.0
"""A good description of a simulator, which tests change."""

from __future__ import annotations

from typing import Any

GOOD: dict[str, Any] = {
    "name": "mine",
    "vehicle": {"length": 4.0, "width": 1.8, "wheelbase": 2.6, "max_steering_angle": 0.5},
    "image": "/car/camera",
    "odometry": "/car/odom",
    "command": {"topic": "/car/cmd", "type": "twist"},
    "road": {"service": "/load_road"},
    "time": {"step": "/step", "seconds": 0.01},
}
