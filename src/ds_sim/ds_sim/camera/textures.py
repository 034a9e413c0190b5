# SPDX-License-Identifier: Apache-2.0
"""Seamless textures of the ground: grass and asphalt."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.spec import Look

TEXTURE_SIZE = 512
"""Side of a texture, pixels of the finest raster (25.6 m)."""


@dataclass(frozen=True)
class Textures:
    """Textures of one look, (TEXTURE_SIZE, TEXTURE_SIZE, 4) uint8 RGBA: grass, its pyramid and mean, and asphalt."""

    grass: tuple[NDArray[np.uint8], ...]
    asphalt: NDArray[np.uint8]
    outside: tuple[int, int, int]


@lru_cache(maxsize=8)
def textures(look: Look, levels: int) -> Textures:
    """Make the textures of a look, with a pyramid of the grass."""
    rng = np.random.default_rng(look.grain_seed)
    grass = _texture(rng, look.grass, look.grass_grain, (1.0, 6.0))
    if look.relief > 0.0:
        grass = _shaded(grass, look)
    asphalt = _texture(rng, look.asphalt, look.asphalt_grain, (0.0, 10.0))
    red, green, blue = (int(round(v)) for v in grass.reshape(-1, 3).mean(axis=0))
    pyramid = [_opaque(grass)]
    while len(pyramid) < levels:
        pyramid.append(halved(pyramid[-1]))
    return Textures(grass=tuple(pyramid), asphalt=_opaque(asphalt), outside=(red, green, blue))


def halved(raster: NDArray[np.uint8], into: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Return a raster of half the size, each pixel the mean of four."""
    size = (raster.shape[1] // 2, raster.shape[0] // 2)
    return np.asarray(cv2.resize(raster, size, into, interpolation=cv2.INTER_AREA), np.uint8)


def _opaque(raster: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(raster, cv2.COLOR_RGB2RGBA), np.uint8)


def _texture(
    rng: np.random.Generator, colour: tuple[int, int, int], grain: float, blurs: tuple[float, float]
) -> NDArray[np.uint8]:
    """Seamless texture of one colour with grain at two scales."""
    total = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE))
    for blur in blurs:
        noise = rng.standard_normal((TEXTURE_SIZE, TEXTURE_SIZE))
        if blur > 0.0:
            wrapped = cv2.copyMakeBorder(noise, 64, 64, 64, 64, cv2.BORDER_WRAP)
            noise = np.asarray(cv2.GaussianBlur(wrapped, (0, 0), blur)[64:-64, 64:-64], np.float64)
        total += noise / noise.std()
    shade = grain * total / math.sqrt(len(blurs))
    return np.clip(np.asarray(colour) + shade[:, :, None], 0, 255).round().astype(np.uint8)


def _shaded(texture: NDArray[np.uint8], look: Look) -> NDArray[np.uint8]:
    """Shade a texture as a relief of its own brightness: lighter on slopes that face the light."""
    height = cv2.copyMakeBorder(texture.mean(axis=2), 16, 16, 16, 16, cv2.BORDER_WRAP)
    height = np.asarray(cv2.GaussianBlur(height, (0, 0), 2.0), np.float64)
    # On a slope that faces the light, height falls towards it.
    slope_y, slope_x = (np.asarray(v)[16:-16, 16:-16] for v in np.gradient(height))
    facing = -(slope_x * math.cos(look.sun_azimuth) + slope_y * math.sin(look.sun_azimuth))
    shade = look.relief * facing / facing.std()
    return np.clip(texture + shade[:, :, None], 0, 255).round().astype(np.uint8)
