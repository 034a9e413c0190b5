"""Textures along a road, which say where conditions cover it: bare pieces of line, repair patches, shadows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_sim.conditions.model import Conditions
from ds_sim.conditions.pieces import pieces
from ds_sim_panda.scene.parameters import LEAD_IN, LEAD_OUT, SHADE_LENGTH
from ds_sim_panda.scene.repairs import repaired
from ds_sim_panda.scene.road_mesh import Course
from ds_sim_panda.scene.textures import upload

FINEST = 0.05
"""Largest length of a texel on roads of up to 819 m; chosen: a third of the width of a line."""
PATCH_TEXEL, PATCH_ROWS = 0.1, 64
"""Largest length of a texel of the patches on roads of up to 1.6 km, and their number across the road; chosen: as long
as wide, so that distant patches fade alike in both directions."""
MOST_TEXELS = 16_384
"""Widest texture that Mesa's software renderer has."""


@dataclass(frozen=True)
class AlongRoad:
    """Textures whose columns run along the road; full where a piece covers it. All but the patches have one row.

    Attributes:
        frame: distance along the road at which the textures start, m, and the inverse of their length, 1/m.
        bare: no paint on the left, centre and right line.
        repaired: patches; rows from the left border of the road to the right one.
        shaded: shadows across the road.
    """

    frame: tuple[float, float]
    bare: Any
    repaired: Any
    shaded: Any


def along_road(course: Course, conditions: Conditions, rng: np.random.Generator) -> AlongRoad:
    """Choose what is covered; more of the same for stronger conditions."""
    c = conditions
    length = float(course.along[-1] - course.along[0])
    texels = min(2 ** math.ceil(math.log2(length / FINEST)), MOST_TEXELS)
    regions = ((0.0, LEAD_IN), (LEAD_IN, length - LEAD_OUT), (length - LEAD_OUT, length))
    lines, patches, shadows = rng.spawn(3)

    def texture(name: str, rng: np.random.Generator, rows: int, size: float, share: float) -> Any:
        covered = [_shares(pieces(rng, regions, size, share), length, texels) for _ in range(rows)]
        image = np.round(255.0 * np.stack(covered, axis=-1)).astype(np.uint8)[None]
        return upload(name, image if rows > 1 else image[..., 0], wrap=False)

    return AlongRoad(
        frame=(float(course.along[0]), 1.0 / length),
        bare=texture("bare", lines, 3, c.line_cover_length, c.line_cover),
        repaired=upload("repaired", _patches(patches, length, 2.0 * course.half_width, c.repair_share), wrap=False),
        shaded=texture("shaded", shadows, 1, SHADE_LENGTH, c.shadow_density),
    )


def _patches(rng: np.random.Generator, length: float, width: float, share: float) -> NDArray[np.uint8]:
    """Texture of the repair patches, 255 where they are."""
    if not share:
        return np.zeros((1, 1), np.uint8)
    columns = min(2 ** math.ceil(math.log2(length / PATCH_TEXEL)), MOST_TEXELS)
    return np.where(repaired(rng, length, width, share, (PATCH_ROWS, columns)), 255, 0).astype(np.uint8)


def _shares(covered: Sequence[tuple[float, float]], length: float, texels: int) -> NDArray[np.float64]:
    """Share of each texel that is covered, (texels,)."""
    if not covered:
        return np.zeros(texels)
    ends = np.array(covered)
    knots = np.concatenate(([0.0], ends.ravel(), [length]))
    so_far = np.concatenate(([0.0], np.repeat(np.cumsum(ends[:, 1] - ends[:, 0]), 2)))
    so_far = np.insert(so_far, 1, 0.0)
    borders = np.interp(np.linspace(0.0, length, texels + 1), knots, so_far)
    return np.asarray(np.clip(np.diff(borders) * texels / length, 0.0, 1.0))
