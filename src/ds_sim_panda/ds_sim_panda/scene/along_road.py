# SPDX-License-Identifier: Apache-2.0
"""Textures along a road with bare pieces of line, repair patches and shadows, as conditions ask for them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.surface import pieces
from ds_sim.conditions.model import Conditions
from ds_sim_panda.scene import parameters
from ds_sim_panda.scene.meshes import Course
from ds_sim_panda.scene.textures import upload

BLOCK = 18.0
"""Length of road of which a share is repaired as of all, m; chosen: about the view ahead, as for pieces of lines."""
SPARE = 2.5
"""Area of all patches over that of the road; chosen: overlapping at random, they leave 8% of it, less than the 40%
that no share repairs."""
_SHIFT = 6
"""Binary places of the corners of patches, in texels."""


def repaired(
    rng: np.random.Generator, length: float, width: float, share: float, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Choose the part of a road that is repaired: the same share of every block, and more of the same for a larger one.

    Patches are laid one after the other, the last one of a block in part of its length; their order does not depend on
    the share. Lengths are in m; the mask has rows across the road, from the left, and columns along it.
    """
    order = _order(rng, length, width, shape)
    mask = np.zeros(shape, np.bool_)
    for columns in np.array_split(np.arange(shape[1]), max(1, round(length / BLOCK))):
        part = order[:, columns]
        wanted = round(share * part.size)
        if wanted:
            mask[:, columns] = part <= np.partition(part, wanted - 1, axis=None)[wanted - 1]
    return mask


def _order(rng: np.random.Generator, length: float, width: float, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Number of the first patch on each texel, and the place along that patch as its fraction."""
    mean = float(np.mean(parameters.PATCH_LENGTHS) * np.mean(parameters.PATCH_WIDTHS))
    count = math.ceil(SPARE * length * width / mean)
    centre = np.column_stack((rng.uniform(0.0, length, count), rng.uniform(0.0, width, count)))
    size = np.column_stack(
        (rng.uniform(*parameters.PATCH_LENGTHS, count), rng.uniform(*parameters.PATCH_WIDTHS, count))
    )
    turn = rng.normal(0.0, parameters.PATCH_TURN, count)
    cut = rng.random(count) < parameters.CUT_SHARE
    size[cut, 0], size[cut, 1] = width * rng.uniform(0.5, 1.2, cut.sum()), rng.uniform(*parameters.CUT_WIDTH, cut.sum())
    turn[cut] += math.pi / 2.0
    ahead = np.column_stack((np.cos(turn), np.sin(turn)))
    left = np.column_stack((-ahead[:, 1], ahead[:, 0]))
    texel = np.array([length / shape[1], width / shape[0]])
    first = np.full(shape, count, np.int32)
    for patch in range(count - 1, -1, -1):  # the first patch lies on top
        half = (ahead[patch] * size[patch, 0] / 2.0, left[patch] * size[patch, 1] / 2.0)
        corners = centre[patch] + np.array(
            [half[0] + half[1], half[0] - half[1], -half[0] - half[1], half[1] - half[0]]
        )
        pixels = np.round((corners / texel - 0.5) * 2.0**_SHIFT).astype(np.int32)
        cv2.fillPoly(first, [pixels], patch, shift=_SHIFT)
    rows, columns = np.indices(shape)
    places = (np.stack((columns, rows), axis=-1) + 0.5) * texel
    # What no patch reaches would come last, from the beginning of the road on.
    centre, ahead, size = (
        np.vstack((table, last))
        for table, last in ((centre, (length / 2, 0.0)), (ahead, (1.0, 0.0)), (size, (length, 1.0)))
    )
    along = ((places - centre[first]) * ahead[first]).sum(axis=-1) / size[first, 0] + 0.5
    return (first + np.clip(along, 0.0, 0.999)).astype(np.float32)


FINEST = 0.05
"""Largest length of a texel on roads of up to 819 m; chosen: a third of the width of a line."""
PATCH_TEXEL, PATCH_ROWS = 0.1, 64
"""Largest length of a texel of the patches on roads of up to 1.6 km, and their number across the road; chosen: as long
as wide, so that distant patches fade alike in both directions."""
MOST_TEXELS = 16_384
"""Widest texture that Mesa's software renderer has."""


@dataclass(frozen=True)
class AlongRoad:
    """Textures whose columns run along the road; full where a piece covers it. All but the patches have one row."""

    # Distance along the road at which the textures start, m, and the inverse of their length, 1/m.
    frame: tuple[float, float]
    bare: Any  # no paint on the left, centre and right line
    repaired: Any  # patches; rows from the left border of the road to the right one
    shaded: Any  # shadows across the road


def along_road(course: Course, conditions: Conditions, rng: np.random.Generator) -> AlongRoad:
    """Choose what is covered; more of the same for stronger conditions."""
    c = conditions
    length = float(course.along[-1] - course.along[0])
    texels = min(2 ** math.ceil(math.log2(length / FINEST)), MOST_TEXELS)
    regions = (
        (0.0, parameters.LEAD_IN),
        (parameters.LEAD_IN, length - parameters.LEAD_OUT),
        (length - parameters.LEAD_OUT, length),
    )
    lines, patches, shadows = rng.spawn(3)

    def texture(name: str, rng: np.random.Generator, rows: int, size: float, share: float) -> Any:
        covered = [_shares(pieces(rng, regions, size, share), length, texels) for _ in range(rows)]
        image = np.round(255.0 * np.stack(covered, axis=-1)).astype(np.uint8)[None]
        return upload(name, image if rows > 1 else image[..., 0], wrap=False)

    return AlongRoad(
        frame=(float(course.along[0]), 1.0 / length),
        bare=texture("bare", lines, 3, c.line_cover_length, c.line_cover),
        repaired=upload("repaired", _patches(patches, length, 2.0 * course.half_width, c.repair_share), wrap=False),
        shaded=texture("shaded", shadows, 1, parameters.SHADE_LENGTH, c.shadow_density),
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
