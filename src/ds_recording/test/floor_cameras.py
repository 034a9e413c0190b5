# SPDX-License-Identifier: Apache-2.0
"""Cameras above the floor, as tests of several packages need them."""

from __future__ import annotations

from ds_recording.floor_camera import FloorCamera


def floor_camera(focal: float, height: float, pitch: float, *, forward: float = 0.0) -> FloorCamera:
    """A pinhole of 160 x 120 px whose axis meets the middle of its picture; px, m and rad."""
    return FloorCamera(
        width_px=160,
        height_px=120,
        focal_px=(focal, focal),
        centre_x_px=79.5,
        centre_y_px=59.5,
        height_m=height,
        pitch_rad=pitch,
        forward_m=forward,
    )
