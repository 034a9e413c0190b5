# SPDX-License-Identifier: Apache-2.0
"""Light and air of a world: sun and sky, and what conditions make of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.optics import KOSCHMIEDER
from ds_sim.camera.surface import SURFACE_CONDITIONS
from ds_sim.conditions.model import Conditions
from ds_sim_panda.scene import parameters
from ds_sim_panda.scene.parameters import Linear

Direction = tuple[float, float, float]
"""Unit vector in the road frame (x east, y north, z up)."""


@dataclass(frozen=True)
class Daylight:
    """Light of sun and sky; together they give level ground a luminance of 1."""

    towards_sun: Direction  # where the sun stands
    sun: Linear  # light on a surface that faces the sun, without the sky's, linear RGB
    sky: Linear  # light of the sky on level ground, which is all that a shadow receives, linear RGB

    @property
    def sun_on_ground(self) -> NDArray[np.float64]:
        """Light of the sun on level ground, (3,) linear RGB."""
        return np.array(self.sun) * self.towards_sun[2]

    def on(self, normals: NDArray[np.float64], *, softness: float | NDArray[np.float64] = 0.0) -> NDArray[np.float64]:
        """Light on unshaded surfaces with unit vectors (..., 3), (..., 3) linear RGB.

        Softness is how far sunlight reaches round a body, 0 (a solid) to 1; leaves let light through.
        """
        facing = np.maximum(((normals * self.towards_sun).sum(axis=-1) + softness) / (1.0 + softness), 0.0)
        # A surface sees a share of (1 + n_z) / 2 of the sky; the ground returns a tenth of the light to the rest.
        sky_share = (1.0 + normals[..., 2]) / 2.0
        ground = 0.1 * (1.0 - sky_share)
        return facing[..., None] * np.array(self.sun) + sky_share[..., None] * np.array(self.sky) + ground[..., None]

    def shaded(self, depth: float) -> NDArray[np.float64]:
        """Light on level ground from which a share of the luminance is taken, first the sun's, (3,) linear RGB."""
        sun, sky = self.sun_on_ground, np.array(self.sky)
        share = float((sun * parameters.LUMINANCE).sum() / ((sun + sky) * parameters.LUMINANCE).sum())
        if depth <= share:
            return np.asarray(sky + (1.0 - depth / share) * sun)
        return np.asarray(sky * (1.0 - depth) / (1.0 - share))

    def behind(self, depth: float) -> Daylight:
        """Light below a layer of this optical depth in the zenith, which scatters sunlight down to the ground."""
        passed = math.exp(-depth / self.towards_sun[2])
        scattered = (1.0 - passed) * self.sun_on_ground
        return Daylight(self.towards_sun, _linear(passed * np.array(self.sun)), _linear(self.sky + scattered))


@cache
def own_daylight() -> Daylight:
    """Light of this world, whose sun stands by the astronomical triangle."""
    cl, sl = math.cos(parameters.LATITUDE), math.sin(parameters.LATITUDE)
    cd, sd = math.cos(parameters.DECLINATION), math.sin(parameters.DECLINATION)
    ch, sh = math.cos(parameters.HOUR_ANGLE), math.sin(parameters.HOUR_ANGLE)
    return clear_daylight((-cd * sh, sd * cl - cd * ch * sl, sd * sl + cd * ch * cl))


def clear_daylight(towards_sun: Direction) -> Daylight:
    """Light under a clear sky (IESNA), with a sun above the horizon."""
    sine = towards_sun[2]
    sun = parameters.SOLAR_ILLUMINANCE * math.exp(-parameters.EXTINCTION / sine)
    sky = parameters.SKY_ILLUMINANCE[0] + parameters.SKY_ILLUMINANCE[1] * math.sqrt(sine)
    total = sun * sine + sky
    return Daylight(
        towards_sun,
        _linear(sun / total * np.array(parameters.SUN_TINT)),
        _linear(sky / total * np.array(parameters.SKY_TINT)),
    )


def _linear(colour: NDArray[np.float64]) -> Linear:
    red, green, blue = colour.tolist()
    return red, green, blue


WORLD_CONDITIONS = SURFACE_CONDITIONS | {"visibility", "sun_azimuth", "sun_elevation"}
"""Conditions that change the world, not only how the camera sees it."""


class Setting:
    """What the conditions of one run make of the world; `rng` decides where the road is covered."""

    def __init__(self, conditions: Conditions, rng: np.random.Generator) -> None:
        self.conditions = conditions
        self.rng = rng
        self.sky = clear_daylight(sun_direction(conditions))  # without fog, whose picture the sky is
        # Air is never clearer than this world's own.
        self._fog = max(KOSCHMIEDER / conditions.visibility - parameters.HAZE, 0.0)
        self.daylight = self.sky.behind(self._fog * parameters.FOG_TOP)  # on everything

    def shader_inputs(self) -> dict[str, float | Sequence[float]]:
        """Values of the uniforms of the shaders of a world with a setting."""
        c, light = self.conditions, self.daylight
        haze = parameters.HAZE + self._fog
        horizon = (parameters.HAZE * np.array(parameters.HORIZON) + self._fog * np.array(parameters.FOG)) / haze
        own = float((np.array(parameters.ASPHALT) * parameters.LUMINANCE).sum())
        reflectance = c.pavement_reflectance or own
        # Concrete is smoother than asphalt: the brighter, the less grain.
        grain = 1.0 / (1.0 + max(math.log2(reflectance / own), 0.0))
        worn = parameters.PAINT_BLOTCHES * min(c.line_contrast, 1.0 - c.line_contrast)
        return {
            "HAZE": haze,
            "FOG_DEPTH": self._fog * parameters.FOG_TOP,
            "HORIZON": horizon.tolist(),
            "SKYLIGHT": list(light.sky),
            "SUNLIGHT": light.sun_on_ground.tolist(),
            "SHADE": light.shaded(c.shadow_depth).tolist(),
            "PAVEMENT": (np.array(parameters.ASPHALT) * (reflectance / own)).tolist(),
            "GRAIN": grain,
            "NEW_ASPHALT": min(parameters.NEW_ASPHALT / reflectance, parameters.PATCH_CONTRAST),
            "PAINT_LEFT": c.line_contrast,
            "BLOTCHES": worn,
        }


def sun_direction(conditions: Conditions) -> Direction:
    """Direction of the sun: where the conditions say, else where it stands in this world."""
    x, y, z = own_daylight().towards_sun
    azimuth = math.atan2(y, x) if conditions.sun_azimuth is None else conditions.sun_azimuth
    elevation = math.asin(z) if conditions.sun_elevation is None else conditions.sun_elevation
    across = math.cos(elevation)
    return across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation)
