# SPDX-License-Identifier: Apache-2.0
"""Applies haze, stray light, dirt on the lens and exposure to rendered images.

Light is linear, decoded from pixel values by the sRGB curve (IEC 61966-2-1): contrast and stray light add in it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.lens import components, sample_rays
from ds_sim.camera.spec import CameraSpec, Colour
from ds_sim.conditions.model import REFERENCE_ILLUMINANCE, Conditions

_STEPS = 4096
"""Steps in which linear light is encoded; chosen: the darkest ones are 0.8 grey levels apart."""


_LEVELS, _LIGHT = np.arange(256) / 255.0, np.arange(_STEPS) / (_STEPS - 1.0)
_TO_LIGHT = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)
_ENCODED = np.where(_LIGHT <= 0.0031308, 12.92 * _LIGHT, 1.055 * _LIGHT ** (1.0 / 2.4) - 0.055)
_TO_LEVEL = np.rint(255.0 * _ENCODED).astype(np.uint8)


def decode(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear light of pixels, 0 to 1 (a white surface in the reference illuminance), same shape."""
    return np.asarray(cv2.LUT(np.ascontiguousarray(pixels), _TO_LIGHT), np.float32).reshape(pixels.shape)


def encode(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Pixels of linear light, clipped to 0 to 1; changes `light`."""
    light *= np.float32(_STEPS - 1)
    light += np.float32(0.5)
    np.clip(light, 0.0, _STEPS - 1, out=light)
    return _TO_LEVEL[light.astype(np.uint16)]


def light_of(colour: tuple[int, int, int]) -> NDArray[np.float32]:
    """Linear light of a colour, (3,)."""
    return decode(np.array(colour, np.uint8).reshape(1, 1, 3)).reshape(3)


LENS_CONDITIONS = frozenset({"illuminance", "veiling_luminance", "low_sun", "lens_dirt", "exposure"})
"""Conditions that change an image without knowing what it shows."""
SENSOR_CONDITIONS = frozenset({"illuminance", "sensor_noise"})
"""Conditions that change the noise of the sensor."""
MOUNT_CONDITIONS = frozenset({"camera_height", "camera_pitch", "camera_yaw"})
"""Conditions that change the mounting of the camera."""
CAMERA_CONDITIONS = LENS_CONDITIONS | SENSOR_CONDITIONS | MOUNT_CONDITIONS
"""Conditions that need nothing of the renderer."""
KOSCHMIEDER = 3.912
"""Extinction coefficient times visibility: -ln 0.02, the contrast threshold of meteorological visibility."""
HAZE_TOP = 100.0
"""Height of the layer of haze, m; chosen: fog near the ground is 15 to 100 m high."""
MAX_GAIN = 16.0
"""Largest factor of the camera's automatic exposure; chosen: four stops, as vehicle cameras have."""
MEAN_LIGHT = 0.18
"""Light that automatic exposure makes of a picture's mean, relative to white: the grey card of exposure meters."""
PHOTON_NOISE = 1.0
"""Least standard deviation of the noise at the reference illuminance, of which more gain makes more, grey levels;
chosen: the shot noise of 65,000 electrons at level 255."""
SMALLEST_ANGLE = 0.5
"""Angle from the sun's centre within which its veil grows no further, degrees: the sun's disc and a pixel."""
DIRT = (0.11, 0.095, 0.075)
"""Light of a smudge, relative to white; chosen: dry mud, lit from all sides."""
DIRT_OPACITY = 0.85
"""Share of the light that a smudge keeps out in its middle; chosen: dried spray of a wet road."""
WHITE = REFERENCE_ILLUMINANCE / math.pi
"""Luminance of a white surface at the reference illuminance, cd/m2."""
_DIRT_SCALES = (3.0, 12.0)
"""Standard deviations of the noise that smudges are cut from, px; chosen: drops and wiped areas."""
_DIRT_BLUR = 2.5
"""Standard deviation of a smudge's edge, px: it lies on the lens, out of focus."""
_Axes = NDArray[np.float64]


def mounted(spec: CameraSpec, conditions: Conditions) -> CameraSpec:
    """Camera as conditions mount it."""
    if not MOUNT_CONDITIONS & conditions.changed.keys():
        return spec
    return replace(
        spec,
        height=spec.height * conditions.camera_height,
        pitch=spec.pitch + conditions.camera_pitch,
        yaw=spec.yaw + conditions.camera_yaw,
    )


def automatic_gain(conditions: Conditions) -> float:
    """Factor by which the camera's automatic exposure makes up for a lack of light, or for light that veils all."""
    reflected = conditions.illuminance / REFERENCE_ILLUMINANCE
    return min(1.0 / (reflected + conditions.veiling_luminance / WHITE / MEAN_LIGHT), MAX_GAIN)


def noise_of(spec: CameraSpec, conditions: Conditions) -> float:
    """Standard deviation of a camera's noise, grey levels: its own, that of dim light, and what is added."""
    dim = max(automatic_gain(conditions) - 1.0, 0.0) * max(spec.noise, PHOTON_NOISE) ** 2
    return math.sqrt(spec.noise**2 + dim + conditions.sensor_noise**2)


class Optics:
    """Applies the conditions of one run to rendered images.

    The sun, azimuth and elevation, rad, is where it stands unless conditions say; `rng` decides the smudges. Distant
    things fade into the haze, the horizon's colour; None for a scene with a haze of its own.
    """

    def __init__(
        self,
        spec: CameraSpec,
        conditions: Conditions,
        rng: np.random.Generator,
        *,
        sun: tuple[float, float],
        haze: Colour | None,
    ) -> None:
        c = conditions
        lens = replace(spec, height=1.0, forward=0.0, pitch=0.0, yaw=0.0)
        rays = sample_rays(lens, 1)[0].reshape(3, spec.height_px, spec.width)
        self._rays = rays / np.linalg.norm(rays, axis=0)
        self._extinction = 0.0 if haze is None else KOSCHMIEDER / c.visibility
        self._airlight = light_of(haze or (0, 0, 0))
        gain = automatic_gain(c) * c.exposure
        self._scale = np.float32(gain * c.illuminance / REFERENCE_ILLUMINANCE)
        self._veil = np.float32(gain * c.veiling_luminance / WHITE)
        # Veiling luminance in cd/m2 of E in lx at an angle in degrees: 10 E / angle^2.
        self._sun_veil = gain * 10.0 * c.low_sun / WHITE
        azimuth = sun[0] if c.sun_azimuth is None else c.sun_azimuth
        elevation = sun[1] if c.sun_elevation is None else c.sun_elevation
        self._sun = np.array(
            [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
        )
        self._dirt = _smudges(rng, spec, c.lens_dirt)[:, :, None] if c.lens_dirt else None

    def apply(self, image: NDArray[np.uint8], axes: _Axes, height: float, rows: tuple[int, int]) -> NDArray[np.uint8]:
        """Return some rows of a rendered image, (rows, columns, 3) uint8 RGB, as they reach the sensor; else zeros.

        The axes are right, down, forward in the road frame, (3, 3), and the height that of the camera above ground, m.
        """
        part = slice(*rows)
        light, rays = decode(image[part]), self._rays[:, part]
        if self._extinction:
            clear = np.exp(np.float32(-self._extinction) * _distances(rays, axes, height))[:, :, None]
            light -= self._airlight
            light *= clear
            light += self._airlight
        light *= self._scale
        if self._dirt is not None:
            light += self._dirt[part] * (np.array(DIRT, np.float32) * self._scale - light)
        light += self._veil
        if self._sun_veil:
            cosine = components(rays, (axes * self._sun).sum(axis=1).tolist())
            angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
            light += np.asarray(self._sun_veil / np.maximum(angle, SMALLEST_ANGLE) ** 2, np.float32)[:, :, None]
        changed = np.zeros_like(image)
        changed[part] = encode(light)
        return changed


def _distances(rays: NDArray[np.float32], axes: _Axes, height: float) -> NDArray[np.float32]:
    """Distance along each ray to the ground, or through the layer of haze, m, (rows, columns)."""
    descent = components(rays, (-axes[:, 2]).tolist())
    depth = np.where(descent > 0.0, np.float32(height), np.float32(HAZE_TOP))
    return np.asarray(depth / np.maximum(np.abs(descent), 1e-4), np.float32)


def camera_under(
    camera: CameraSpec,
    conditions: Conditions,
    rng: np.random.Generator,
    *,
    sun: tuple[float, float],
    haze: Colour | None,
) -> tuple[CameraSpec, Optics | None]:
    """Return a camera as conditions mount it, with their noise, and its optics; None where they leave the light alone.

    The arguments are those of `Optics`.
    """
    spec = replace(mounted(camera, conditions), noise=noise_of(camera, conditions))
    changing = LENS_CONDITIONS if haze is None else LENS_CONDITIONS | {"visibility"}
    unchanged = not changing & conditions.changed.keys()
    return spec, None if unchanged else Optics(spec, conditions, rng, sun=sun, haze=haze)


def _smudges(rng: np.random.Generator, spec: CameraSpec, share: float) -> NDArray[np.float32]:
    """Opacity of the dirt on the lens, (rows, columns): smudges over a share of it, and more of the same for more."""
    shape = (spec.height_px, spec.width)
    noise = np.zeros(shape)
    for scale in _DIRT_SCALES:
        layer = np.asarray(cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), scale))
        noise += layer / layer.std()
    dirty = np.zeros(noise.size, np.float32)
    dirty[np.argsort(-noise.ravel(), kind="stable")[: round(share * noise.size)]] = DIRT_OPACITY
    return np.asarray(cv2.GaussianBlur(dirty.reshape(shape), (0, 0), _DIRT_BLUR), np.float32)
