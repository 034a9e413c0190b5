# SPDX-License-Identifier: Apache-2.0
"""Draws the background above the horizon, all around: sky, the sun's glow and a distant skyline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.lens import Vector, rays
from ds_sim.camera.spec import CameraSpec, Look

_STEP = 8
"""Spacing of the grid on which directions are computed, px; chosen: linear interpolation is within 0.1 px."""
_BELOW = 4
"""Rows painted below the horizon, so that the row of the horizon is not read at the border."""
_FINE = 4
"""Supersampling factor of the painted skyline."""
_TOP = math.radians(75.0)
"""Highest elevation painted, rad; chosen: above the view of any camera."""
Painted = NDArray[np.uint8]


class Panorama:
    """Background of one camera and look."""

    def __init__(self, spec: CameraSpec, look: Look) -> None:
        self._spec = spec
        self._scale = float(spec.intrinsics[0, 0])
        self._strip = _painted(look, self._scale)
        self._columns_per_turn = round(2 * math.pi * self._scale)
        columns = np.arange(-1.0, math.ceil(spec.width / _STEP) + 1) * _STEP + (_STEP - 1) / 2
        rows = np.arange(-1.0, math.ceil(spec.height_px / _STEP) + 1) * _STEP + (_STEP - 1) / 2
        self._rays = rays(spec, np.asarray(columns[None, :], np.float64), np.asarray(rows[:, None], np.float64))

    def draw(self, frame: Painted, top: int, bottom: int, axes: Sequence[Vector], yaw: float) -> None:
        """Draw the background into the rows from `top` to `bottom` of an RGBA image, in place.

        The optical axes right, down, forward are in coordinates that are rotated with the vehicle by `yaw`, rad.
        """
        if bottom <= top:
            return
        first, last = top // _STEP, min(math.ceil(bottom / _STEP) + 2, self._rays.shape[1])
        x, y, z = np.einsum("ij,irc->jrc", axes, self._rays[:, first:last])
        # Columns run to the right, that is clockwise: they increase with -azimuth.
        turned = (-yaw * self._scale + math.pi * self._scale) % self._columns_per_turn
        column = turned - np.arctan2(y, x) * self._scale
        up = (self._strip.shape[0] - _BELOW - 0.5) - np.arctan2(z, np.hypot(x, y)) * self._scale
        size = (self._rays.shape[2] * _STEP, (last - first) * _STEP)
        begin = top + _STEP - first * _STEP
        maps = [
            cv2.resize(v.astype(np.float32), size)[begin : begin + bottom - top, _STEP : _STEP + self._spec.width]
            for v in (column, up)
        ]
        cv2.remap(self._strip, maps[0], maps[1], cv2.INTER_LINEAR, frame[top:bottom], cv2.BORDER_REPLICATE)


@lru_cache(maxsize=8)
def _painted(look: Look, scale: float) -> Painted:
    """Painted strip over two full turns, rows by elevation and columns by azimuth, RGBA; `scale` in pixels per rad.

    Column 0 is half a turn to the left of +x.
    """
    turn, rows = round(2 * math.pi * scale), math.ceil(_TOP * scale)
    # Columns run to the right, so azimuth decreases.
    azimuth = math.pi - (np.arange(turn * _FINE) + 0.5) / _FINE / scale
    elevation = np.maximum((rows - np.arange((rows + _BELOW) * _FINE) / _FINE) / scale, 0.0)
    share = np.minimum(elevation / math.radians(look.sky_height), 1.0)[:, None]
    sky = (1 - share) * np.asarray(look.horizon, float) + share * np.asarray(look.sky_top, float)
    coarse_elevation = elevation[_FINE // 2 :: _FINE]
    image = np.repeat(sky[_FINE // 2 :: _FINE, None, :], turn, axis=1)
    if look.sun_glow > 0.0:
        offset = azimuth[_FINE // 2 :: _FINE] - look.sun_azimuth
        cosine = np.cos(coarse_elevation)[:, None] * math.cos(look.sun_elevation) * np.cos(offset)[None, :]
        cosine = cosine + np.sin(coarse_elevation)[:, None] * math.sin(look.sun_elevation)
        # A broad glow, as in one-lobe approximations of sky models.
        image += look.sun_glow * np.exp((cosine - 1.0) * 4.0)[:, :, None]
    if look.lamps:
        _add_lamps(image, look, scale)
    for height, colour in _skyline(look, azimuth):
        first = int((elevation < height.max()).argmax()) // _FINE  # row, below which all that is covered lies
        covered = (elevation[first * _FINE :, None] < height[None, :]).astype(np.float32)
        cover = cv2.resize(covered, (turn, rows + _BELOW - first), interpolation=cv2.INTER_AREA)[:, :, None]
        image[first:] = image[first:] * (1 - cover) + cover * colour
    strip = np.full((rows + _BELOW, turn, 4), 255, np.uint8)
    strip[:, :, :3] = np.clip(image, 0, 255).round()
    return np.ascontiguousarray(np.concatenate((strip, strip), axis=1))


def _add_lamps(image: NDArray[np.float64], look: Look, scale: float) -> None:
    """Add the lamps of a ceiling: bright discs above the skyline, smaller and denser towards the horizon."""
    rng = np.random.default_rng(look.grain_seed + 1)
    turn = image.shape[1]
    light = np.zeros(image.shape[:2], np.float32)
    for _ in range(look.lamps):
        # Seen from below, lamps spread evenly over a ceiling crowd towards the horizon.
        elevation = math.atan(math.tan(math.radians(look.hills)) / rng.uniform(0.15, 1.0))
        column, row = int(rng.integers(0, turn)), image.shape[0] - _BELOW - elevation * scale
        radius = scale * (0.008 + 0.03 * math.sin(elevation))
        for wrapped in (column - turn, column, column + turn):
            centre, axes = (wrapped * 16, int(row * 16)), (int(radius * 32), int(radius * 16))
            cv2.ellipse(light, centre, axes, 0.0, 0.0, 360.0, 1.0, -1, cv2.LINE_AA, 4)
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), 0.6))
    halo = np.asarray(cv2.GaussianBlur(light, (0, 0), 0.04 * scale))
    image += 190.0 * np.maximum(light, 0.35 * halo)[:, :, None]


def _skyline(look: Look, azimuth: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Layers of the skyline, farthest first: elevation of the top by azimuth (rad), and colour."""
    top = math.radians(look.hills)
    if top <= 0.0:
        return []
    rng = np.random.default_rng(look.grain_seed)
    colour = np.asarray(look.hill_colour, float)
    layers = []
    if look.skyline == "room":
        # The wall of a room, with furniture and doorways of other shades in front of it.
        layers.append((np.full_like(azimuth, top), colour))
        for _ in range(22):
            middle, half = rng.uniform(-math.pi, math.pi), rng.uniform(0.03, 0.16)
            near = np.abs((azimuth - middle + math.pi) % (2 * math.pi) - math.pi) < half
            tone = np.clip(colour * rng.uniform(0.25, 1.25) + rng.normal(0.0, 5.0, 3), 0, 255)
            layers.append((np.where(near, top * rng.uniform(0.15, 0.95), 0.0), tone))
        return layers
    for haze, share, waves in ((0.45, 1.0, range(2, 14)), (0.1, 0.6, range(5, 40))):
        components = [rng.uniform(0.3, 1.0) / n * np.sin(n * azimuth + rng.uniform(0, 2 * math.pi)) for n in waves]
        ridge = np.sum(components, axis=0)
        height = share * top * (0.25 + 0.75 * (ridge - ridge.min()) / (ridge.max() - ridge.min()))
        layers.append((height, (1 - haze) * colour + haze * np.asarray(look.horizon, float)))
    if look.skyline == "trees":
        tree = np.zeros_like(azimuth)
        for _ in range(260):
            middle, half = rng.uniform(-math.pi, math.pi), rng.uniform(0.006, 0.03)
            offset = np.abs((azimuth - middle + math.pi) % (2 * math.pi) - math.pi) / half
            crown = top * rng.uniform(0.3, 0.9) * np.sqrt(np.clip(1 - offset**2, 0.0, 1.0))
            tree = np.maximum(tree, crown)
        layers.append((tree, colour * 0.7))
    return layers
