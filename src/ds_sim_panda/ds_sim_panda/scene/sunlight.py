"""Position of the sun, and the light of sun and sky as shares of full daylight on level ground."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ds_sim_panda.scene.parameters import (
    DECLINATION,
    EXTINCTION,
    HOUR_ANGLE,
    LATITUDE,
    LUMINANCE,
    SKY_ILLUMINANCE,
    SKY_TINT,
    SOLAR_ILLUMINANCE,
    SUN_TINT,
    Linear,
)

Direction = tuple[float, float, float]
"""Unit vector in the road frame (x east, y north, z up)."""


@dataclass(frozen=True)
class Daylight:
    """Light of sun and sky; together they give level ground a luminance of 1.

    Attributes:
        towards_sun: where the sun stands.
        sun: light on a surface that faces the sun, without the sky's, linear RGB.
        sky: light of the sky on level ground, which is all that a shadow receives, linear RGB.
    """

    towards_sun: Direction
    sun: Linear
    sky: Linear

    @property
    def sun_on_ground(self) -> NDArray[np.float64]:
        """Light of the sun on level ground, (3,) linear RGB."""
        return np.array(self.sun) * self.towards_sun[2]

    def on(self, normals: NDArray[np.float64], *, softness: float | NDArray[np.float64] = 0.0) -> NDArray[np.float64]:
        """Light on unshaded surfaces, (..., 3) linear RGB.

        Args:
            normals: unit vectors, (..., 3).
            softness: how far sunlight reaches round a body, 0 (a solid) to 1; leaves let light through.
        """
        facing = np.maximum(((normals * self.towards_sun).sum(axis=-1) + softness) / (1.0 + softness), 0.0)
        # A surface sees a share of (1 + n_z) / 2 of the sky; the ground returns a tenth of the light to the rest.
        seen = (1.0 + normals[..., 2]) / 2.0
        ground = 0.1 * (1.0 - seen)
        return facing[..., None] * np.array(self.sun) + seen[..., None] * np.array(self.sky) + ground[..., None]

    def shaded(self, depth: float) -> NDArray[np.float64]:
        """Light on level ground from which a share of the luminance is taken, first the sun's, (3,) linear RGB."""
        sun, sky = self.sun_on_ground, np.array(self.sky)
        share = float((sun * LUMINANCE).sum() / ((sun + sky) * LUMINANCE).sum())
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
    cl, sl = math.cos(LATITUDE), math.sin(LATITUDE)
    cd, sd = math.cos(DECLINATION), math.sin(DECLINATION)
    ch, sh = math.cos(HOUR_ANGLE), math.sin(HOUR_ANGLE)
    return clear_daylight((-cd * sh, sd * cl - cd * ch * sl, sd * sl + cd * ch * cl))


def clear_daylight(towards_sun: Direction) -> Daylight:
    """Light under a clear sky (IESNA), with a sun above the horizon."""
    sine = towards_sun[2]
    sun = SOLAR_ILLUMINANCE * math.exp(-EXTINCTION / sine)
    sky = SKY_ILLUMINANCE[0] + SKY_ILLUMINANCE[1] * math.sqrt(sine)
    total = sun * sine + sky
    return Daylight(towards_sun, _linear(sun / total * np.array(SUN_TINT)), _linear(sky / total * np.array(SKY_TINT)))


def _linear(colour: NDArray[np.float64]) -> Linear:
    red, green, blue = colour.tolist()
    return red, green, blue
