# SPDX-License-Identifier: Apache-2.0
"""Sky with clouds and a far skyline, as a dome that follows the camera."""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_sim_panda.scene import parameters
from ds_sim_panda.scene.meshes import VERTEX, mesh_node, strip_triangles
from ds_sim_panda.scene.setting import Daylight
from ds_sim_panda.scene.textures import noise, stored, upload

LOWEST, HIGHEST = math.radians(-4.0), math.radians(56.0)
"""Elevations between which the sky is painted; above, its last row goes on."""
ROWS, COLUMNS = 160, 1024
CLOUD_BASE = 0.12
"""Flattens the clouds' plane, so that they do not shrink to nothing at the horizon; chosen."""


@lru_cache(maxsize=2)
def sky_texture(daylight: Daylight) -> Any:
    """Panorama of the sky, all azimuths by elevations from `LOWEST` to `HIGHEST`."""
    return upload("sky", stored(sky_colours(daylight)), wrap=False)


def sky_colours(daylight: Daylight) -> NDArray[np.float64]:
    """Linear colours of the panorama, (ROWS, COLUMNS, 3); columns run counter-clockwise from +x."""
    elevation = LOWEST + (np.arange(ROWS) + 0.5) / ROWS * (HIGHEST - LOWEST)
    azimuth = (np.arange(COLUMNS) + 0.5) / COLUMNS * math.tau
    height = np.clip(elevation / parameters.ZENITH_ELEVATION, 0.0, 1.0)[:, None, None]
    share = (1.0 - height) ** 3.0
    sky = np.broadcast_to(share * parameters.HORIZON + (1.0 - share) * parameters.ZENITH, (ROWS, COLUMNS, 3)).copy()
    sun = daylight.towards_sun
    towards = np.cos(elevation)[:, None] * (np.cos(azimuth) * sun[0] + np.sin(azimuth) * sun[1])
    towards += np.sin(elevation)[:, None] * sun[2]
    sky *= (1.0 + 0.35 * np.clip(towards, 0.0, 1.0) ** 3)[..., None]
    _add_clouds(sky, elevation, azimuth)
    _add_skyline(sky, elevation, daylight)
    return sky


def _add_clouds(sky: NDArray[np.float64], elevation: NDArray[np.float64], azimuth: NDArray[np.float64]) -> None:
    """Clouds lie on a plane overhead; light from the sun's side, grey at their base."""
    field, threshold = _cloud_field()
    reach = 1.0 / (np.sin(np.maximum(elevation, 0.0)) + CLOUD_BASE)

    def cover(shift: float) -> NDArray[np.float64]:
        r = (reach + shift)[:, None]
        rows = (r * np.sin(azimuth) * 60.0).astype(int) % 512
        columns = (r * np.cos(azimuth) * 60.0).astype(int) % 512
        return np.asarray(np.clip((field[rows, columns] - threshold) / 1.1, 0.0, 1.0))

    thickness = cover(0.0)
    fading = np.clip(np.sin(np.maximum(elevation, 0.0)) / 0.10, 0.0, 1.0)[:, None]
    opacity = (np.sqrt(thickness) * fading * 0.9)[..., None]
    shade = (1.0 - 0.30 * cover(0.25))[..., None]
    sky *= 1.0 - opacity
    sky += opacity * shade * parameters.CLOUD


@cache
def _cloud_field() -> tuple[NDArray[np.float64], float]:
    """Thickness of the clouds on their plane, (512, 512), and that above which they are seen."""
    field = noise((512, 512), 8, 30, octaves=6, fade=0.55)
    return field, float(np.quantile(field, 1.0 - parameters.CLOUD_COVER))


def _add_skyline(sky: NDArray[np.float64], elevation: NDArray[np.float64], daylight: Daylight) -> None:
    """Hills at 6 km and woods at 1.2 km, each behind the haze of its distance."""
    light = daylight.on(np.array([0.0, 0.0, 1.0]))
    for distance, mean, varies, colour, cells, seed in (
        (6000.0, 0.030, 0.009, 0.8 * np.array(parameters.LEAVES) * light, 6, 31),
        (1200.0, 0.006, 0.0028, 0.55 * np.array(parameters.LEAVES) * light, 96, 32),
    ):
        outline = mean + varies * noise((8, COLUMNS), cells, seed, octaves=4, fade=0.6)[0]
        arrives = math.exp(-parameters.HAZE * distance)
        shown = arrives * colour + (1.0 - arrives) * np.array(parameters.HORIZON)
        pixel = (HIGHEST - LOWEST) / ROWS
        share = np.clip((outline[None] - elevation[:, None]) / pixel + 0.5, 0.0, 1.0)[..., None]
        sky += share * (shown - sky)


def sky_dome() -> Any:
    """Panda3D's node of the dome, around the origin."""
    azimuths = np.linspace(0.0, math.tau, 65)
    elevations = np.concatenate((np.linspace(LOWEST, math.radians(40.0), 9), [HIGHEST, math.radians(90.0)]))
    vertices = np.zeros((len(elevations), len(azimuths)), VERTEX)
    radius = 100.0
    flat = radius * np.cos(elevations)[:, None]
    vertices["position"] = np.stack(
        np.broadcast_arrays(flat * np.cos(azimuths), flat * np.sin(azimuths), radius * np.sin(elevations)[:, None]),
        axis=-1,
    )
    vertices["texture"][..., 0] = azimuths / math.tau
    vertices["texture"][..., 1] = ((elevations - LOWEST) / (HIGHEST - LOWEST))[:, None]
    return mesh_node("sky", vertices.reshape(-1), strip_triangles(*vertices.shape))
