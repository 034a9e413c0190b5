# SPDX-License-Identifier: Apache-2.0
"""Turn and way between two images, against a hall and a floor that are drawn here."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_recording.floor_camera import FloorCamera
from ds_recording.motion import HintFinder

Array = NDArray[np.float64]
CAMERA = FloorCamera(
    width_px=160, height_px=120, focal_px=(90.0,) * 2, centre_x_px=79.5, centre_y_px=59.5, height_m=0.8, pitch_rad=0.3
)
"""In lane widths."""
RNG = np.random.default_rng(3)
WALL = cv2.GaussianBlur(RNG.normal(0.0, 1.0, (256, 2048)).astype(np.float32), (0, 0), 4.0) * 600.0 + 120.0
FLOOR = cv2.GaussianBlur(RNG.normal(0.0, 1.0, (1024, 1024)).astype(np.float32), (0, 0), 3.0) * 250.0 + 110.0


def picture(pose: Array, *, wall: bool = True) -> NDArray[np.uint8]:
    """What the camera sees from x, y, yaw: a round wall, and the floor."""
    rows, columns = np.mgrid[0:120, 0:160].astype(float)
    right, down = (columns - CAMERA.centre_x_px) / CAMERA.focal_px[0], (rows - CAMERA.centre_y_px) / CAMERA.focal_px[1]
    cos, sin = math.cos(0.3), math.sin(0.3)
    ahead, left, up = cos - down * sin, -right, -(sin + down * cos)
    yaw = pose[2] + np.arctan2(left, ahead)
    height = up / np.hypot(ahead, left)
    place = np.stack(((yaw % (2 * math.pi)) / (2 * math.pi) * 2047, 255 - 255 * height.clip(0, 1)), -1)
    above = cv2.remap(WALL, place.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    reach = 0.8 / np.maximum(-up, 0.02)
    x = pose[0] + reach * (ahead * math.cos(pose[2]) - left * math.sin(pose[2]))
    y = pose[1] + reach * (ahead * math.sin(pose[2]) + left * math.cos(pose[2]))
    cells = np.stack((x * 40 % 1023, y * 40 % 1023), -1).astype(np.float32)
    below = cv2.remap(FLOOR, cells, None, cv2.INTER_LINEAR)
    grey = np.where(up > 0.0, above if wall else 128.0, below).clip(0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def test_turns_and_ways_are_found() -> None:
    for turn, way in ((0.0, 0.2), (0.12, 0.3), (-0.15, 0.1), (0.03, 0.0)):
        finder = HintFinder(CAMERA)
        assert np.isinf(finder.see(picture(np.array([3.0, 4.0, 0.4]))).std).all()
        after = np.array([3.0 + way * math.cos(0.4), 4.0 + way * math.sin(0.4), 0.4 + turn])
        hint = finder.see(picture(after))
        assert abs(hint.step[2] - turn) < 0.003 and hint.std[2] < 0.02
        assert abs(hint.step[0] - way) < 0.02 and np.isfinite(hint.std[0])
        assert math.isinf(hint.std[1])


def test_a_plain_sky_and_another_room_say_nothing() -> None:
    finder = HintFinder(CAMERA)
    finder.see(picture(np.array([3.0, 4.0, 0.4]), wall=False))
    assert np.isinf(finder.see(picture(np.array([3.2, 4.0, 0.4]), wall=False)).std).all()
    finder.see(picture(np.array([3.0, 4.0, 0.4])))
    assert np.isinf(finder.see(picture(np.array([3.0, 4.0, 2.4]))).std).all()


def test_a_camera_that_looks_down_says_nothing() -> None:
    finder = HintFinder(replace(CAMERA, pitch_rad=0.9))
    for x in (0.0, 0.1):
        assert np.isinf(finder.see(picture(np.array([x, 0.0, 0.0]))).std).all()
