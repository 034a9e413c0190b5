"""Position of the sun, and the light of sun and sky as shares of full daylight on level ground."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ds_sim_panda.scene.parameters import (
    DECLINATION,
    EXTINCTION,
    HOUR_ANGLE,
    LATITUDE,
    SKY_ILLUMINANCE,
    SKY_TINT,
    SOLAR_ILLUMINANCE,
    SUN_TINT,
)


def sun_direction() -> NDArray[np.float64]:
    """Unit vector towards the sun in the road frame (x east, y north, z up), from the astronomical triangle."""
    cl, sl = math.cos(LATITUDE), math.sin(LATITUDE)
    cd, sd = math.cos(DECLINATION), math.sin(DECLINATION)
    ch, sh = math.cos(HOUR_ANGLE), math.sin(HOUR_ANGLE)
    return np.array([-cd * sh, sd * cl - cd * ch * sl, sd * sl + cd * ch * cl])


def _illuminances() -> tuple[float, float]:
    """Of a surface that faces the sun, and of level ground under the sky alone, as shares of full daylight."""
    sine = float(sun_direction()[2])
    sun = SOLAR_ILLUMINANCE * math.exp(-EXTINCTION / sine)
    sky = SKY_ILLUMINANCE[0] + SKY_ILLUMINANCE[1] * math.sqrt(sine)
    total = sun * sine + sky
    return sun / total, sky / total


def sunlight() -> NDArray[np.float64]:
    """Light on a surface that faces the sun, without the sky's, (3,) linear RGB."""
    return _illuminances()[0] * np.array(SUN_TINT)


def skylight() -> NDArray[np.float64]:
    """Light of the sky on level ground, which is all that a shadow receives, (3,) linear RGB."""
    return _illuminances()[1] * np.array(SKY_TINT)


def light_on(normals: NDArray[np.float64], *, softness: float | NDArray[np.float64] = 0.0) -> NDArray[np.float64]:
    """Light on unshaded surfaces, (..., 3) linear RGB.

    Args:
        normals: unit vectors, (..., 3).
        softness: how far sunlight reaches round a body, 0 (a solid) to 1; leaves let light through.
    """
    facing = np.maximum((normals @ sun_direction() + softness) / (1.0 + softness), 0.0)
    # A surface sees a share of (1 + n_z) / 2 of the sky; the ground returns a tenth of the light to the rest.
    seen = (1.0 + normals[..., 2]) / 2.0
    ground = 0.1 * (1.0 - seen)
    return facing[..., None] * sunlight() + seen[..., None] * skylight() + ground[..., None]
