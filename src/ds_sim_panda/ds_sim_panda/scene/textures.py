# SPDX-License-Identifier: Apache-2.0
"""Textures of all surfaces, made by code: noise on a torus, so that they tile. Made once for each process.

Values are square roots of reflectances (see `shaders`).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim_panda.scene.graphics import panda
from ds_sim_panda.scene.parameters import ASPHALT, GRASS, GRAVEL, Linear

_SEED = 14
"""Of all noise; chosen: part of the world's look, the same in every run."""


def noise(size: tuple[int, int], cells: int, seed: int, *, octaves: int = 1, fade: float = 0.5) -> NDArray[np.float64]:
    """Smooth noise of rows and columns that tiles, with mean 0 and standard deviation 1.

    It has random values at so many cells along each side; each further octave has twice the cells, and an amplitude
    that fades by a factor.
    """
    total = np.zeros(size)
    for octave in range(octaves):
        count = cells * 2**octave
        values = np.random.default_rng((_SEED, seed, octave)).normal(size=(count, count)).astype(np.float32)
        padded = np.pad(values, 2, mode="wrap")
        scale = size[0] / count, size[1] / count
        large = cv2.resize(
            padded,
            (round(padded.shape[1] * scale[1]), round(padded.shape[0] * scale[0])),
            interpolation=cv2.INTER_CUBIC,
        )
        top, left = round(2 * scale[0]), round(2 * scale[1])
        total += fade**octave * large[top : top + size[0], left : left + size[1]]
    total -= total.mean()
    return np.asarray(total / total.std())


def stored(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Values as textures hold them."""
    return np.round(255.0 * np.sqrt(np.clip(linear, 0.0, 1.0))).astype(np.uint8)


def surface(colour: Linear, shade: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reflectance of a surface whose brightness varies, (rows, columns, 3)."""
    return np.asarray(colour) * np.maximum(shade, 0.0)[..., None]


def upload(name: str, image: NDArray[np.uint8], *, wrap: bool = True) -> Any:
    """Panda3D's texture of an image with mipmaps; unless it wraps, its border goes on.

    The image is (rows, columns), or with 2 to 4 channels; row 0 at v = 0. With one more dimension in front: layers.
    """
    core = panda()
    layered = image.ndim == 4
    channels = 1 if image.ndim == 2 else image.shape[-1]
    rows, columns = image.shape[1:3] if layered else image.shape[:2]
    kind = {1: core.Texture.F_red, 2: core.Texture.F_rg, 3: core.Texture.F_rgb, 4: core.Texture.F_rgba}[channels]
    texture = core.Texture(name)
    if layered:
        texture.setup_2d_texture_array(columns, rows, len(image), core.Texture.T_unsigned_byte, kind)
    else:
        texture.setup_2d_texture(columns, rows, core.Texture.T_unsigned_byte, kind)
    if channels > 2:  # Panda3D's order is BGR
        image = image[..., [2, 1, 0, 3][:channels]]
    texture.set_ram_image(np.ascontiguousarray(image).tobytes())
    texture.set_minfilter(core.SamplerState.FT_linear_mipmap_linear)
    texture.set_magfilter(core.SamplerState.FT_linear)
    mode = core.SamplerState.WM_repeat if wrap else core.SamplerState.WM_clamp
    texture.set_wrap_u(mode)
    texture.set_wrap_v(mode)
    texture.set_keep_ram_image(False)
    return texture


@cache
def grass() -> Any:
    """Meadow, 8 m wide: blades, tufts, and some dry ones."""
    size = (512, 512)
    shade = 1.0 + 0.20 * noise(size, 256, 1) + 0.13 * noise(size, 48, 2, octaves=2)
    colour = surface(GRASS, shade)
    dry = np.clip(0.5 * noise(size, 32, 3, octaves=3) - 0.3, 0.0, 0.6)[..., None]
    return upload("grass", stored(colour * (1.0 - dry) + dry * shade[..., None] * (0.16, 0.15, 0.06)))


@cache
def gravel() -> Any:
    """Stones and soil with some weeds, 4 m wide."""
    size = (256, 256)
    shade = 1.0 + 0.22 * noise(size, 128, 4) + 0.12 * noise(size, 24, 5, octaves=2)
    weeds = np.clip(0.6 * noise(size, 12, 6, octaves=3) - 0.35, 0.0, 0.7)[..., None]
    return upload("gravel", stored(surface(GRAVEL, shade) * (1.0 - weeds) + weeds * surface(GRASS, shade)))


@cache
def asphalt() -> Any:
    """Asphalt, 4 m wide: chippings, and in the fourth channel how far paint is worn off them."""
    size = (512, 512)
    fine = noise(size, 256, 7)
    shade = 1.0 + 0.16 * fine + 0.10 * noise(size, 128, 8) + 0.05 * noise(size, 16, 9, octaves=2)
    wear = np.clip(0.5 - 0.25 * fine + 0.3 * noise(size, 32, 10, octaves=3), 0.0, 1.0)
    return upload("asphalt", np.dstack((stored(surface(ASPHALT, shade)), np.round(255.0 * wear).astype(np.uint8))))


@cache
def patches() -> Any:
    """Slow variation for all surfaces, 0.5 on average: broad in the first channel, finer in the second."""
    size = (256, 256)
    broad = 0.5 + 0.09 * noise(size, 6, 11, octaves=4)
    fine = 0.5 + 0.20 * noise(size, 16, 12, octaves=3)
    return upload("patches", stored(np.dstack((broad, fine, broad))))


LAYERS = ("leaves", "needles", "bark", "wall", "roof", "plain")
"""Layers of `materials`, by which texture coordinates name them."""


@cache
def materials() -> Any:
    """Textures of everything beside the road, relative to the colour of their material: layers of `LAYERS`."""
    size = (128, 128)
    grey: dict[str, NDArray[np.float64]] = {
        "leaves": 0.72 + 0.16 * noise(size, 16, 20) + 0.12 * noise(size, 32, 21, octaves=2),
        "needles": 0.74 + 0.15 * noise(size, 32, 22) + 0.10 * noise(size, 8, 23, octaves=2),
        "bark": 0.7 + 0.2 * np.repeat(noise((8, 128), 8, 24)[:1], 128, axis=0) + 0.08 * noise(size, 16, 25),
        "wall": 0.9 + 0.03 * noise(size, 16, 26, octaves=3),
        "roof": 0.72 + 0.10 * noise(size, 16, 27),
        "plain": np.full(size, 0.95),
    }
    layers = {name: surface((1.0, 1.0, 1.0), shade) for name, shade in grey.items()}
    # One bay of a wall is 3 m wide and a storey high: a window with frame and sill.
    layers["wall"][40:104, 40:88] = (0.95, 0.93, 0.90)
    layers["wall"][45:100, 45:62] = layers["wall"][45:100, 66:83] = (0.06, 0.075, 0.10)
    layers["wall"][34:40, 36:92] = 0.55
    # Rows of tiles: each throws a shadow on the next one.
    layers["roof"][np.arange(128) % 16 < 4] *= 0.55
    layers["roof"][:, np.arange(128) % 16 < 2] *= 0.8
    return upload("materials", np.stack([stored(layers[name]) for name in LAYERS]))
