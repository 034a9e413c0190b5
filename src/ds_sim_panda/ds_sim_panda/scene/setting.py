"""Conditions of this world: its light, its haze, and the state of its road."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ds_sim.conditions.model import Conditions
from ds_sim_panda.scene.parameters import (
    ASPHALT,
    FOG,
    FOG_TOP,
    HAZE,
    HORIZON,
    KOSCHMIEDER,
    LUMINANCE,
    NEW_ASPHALT,
    PAINT_BLOTCHES,
    PATCH_CONTRAST,
)
from ds_sim_panda.scene.sunlight import Direction, clear_daylight, own_daylight

WORLD_CONDITIONS = frozenset(
    {"line_contrast", "line_cover", "line_cover_length", "shadow_density", "shadow_depth", "pavement_reflectance",
     "repair_share", "visibility", "sun_azimuth", "sun_elevation"}
)  # fmt: skip
"""Conditions that change the world, not only how the camera sees it."""


class Setting:
    """What the conditions of one run make of the world.

    Attributes:
        conditions: of the run.
        rng: decides where the road is covered.
        sky: light under the sky without fog, whose picture the sky is.
        daylight: light on everything.

    Args:
        conditions: of the run.
        rng: source of all that is random.
    """

    def __init__(self, conditions: Conditions, rng: np.random.Generator) -> None:
        self.conditions = conditions
        self.rng = rng
        self.sky = clear_daylight(sun_direction(conditions))
        # Air is never clearer than this world's own.
        self._fog = max(KOSCHMIEDER / conditions.visibility - HAZE, 0.0)
        self.daylight = self.sky.behind(self._fog * FOG_TOP)

    def shader_inputs(self) -> dict[str, float | Sequence[float]]:
        """Values of the uniforms of the shaders of a world with a setting."""
        c, light = self.conditions, self.daylight
        haze = HAZE + self._fog
        own = float((np.array(ASPHALT) * LUMINANCE).sum())
        reflectance = c.pavement_reflectance or own
        # Concrete is smoother than asphalt: the brighter, the less grain.
        grain = 1.0 / (1.0 + max(math.log2(reflectance / own), 0.0))
        worn = PAINT_BLOTCHES * min(c.line_contrast, 1.0 - c.line_contrast)
        return {
            "HAZE": haze,
            "FOG_DEPTH": self._fog * FOG_TOP,
            "HORIZON": _listed((HAZE * np.array(HORIZON) + self._fog * np.array(FOG)) / haze),
            "SKYLIGHT": list(light.sky),
            "SUNLIGHT": _listed(light.sun_on_ground),
            "SHADE": _listed(light.shaded(c.shadow_depth)),
            "PAVEMENT": _listed(np.array(ASPHALT) * (reflectance / own)),
            "GRAIN": grain,
            "NEW_ASPHALT": min(NEW_ASPHALT / reflectance, PATCH_CONTRAST),
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


def _listed(colour: NDArray[np.float64]) -> list[float]:
    values: list[float] = colour.tolist()
    return values
