"""Repair patches of a road: rectangles of many sizes, mostly along the road, some of them cuts across it."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim_panda.scene.parameters import CUT_SHARE, CUT_WIDTH, PATCH_LENGTHS, PATCH_TURN, PATCH_WIDTHS

BLOCK = 18.0
"""Length of road of which a share is repaired as of all, m; chosen: about the view ahead, as for pieces of lines."""
SPARE = 2.5
"""Area of all patches over that of the road; chosen: overlapping at random, they leave 8 % of it, less than the 40 %
that no share repairs."""
_SHIFT = 6
"""Binary places of the corners of patches, in texels."""


def repaired(
    rng: np.random.Generator, length: float, width: float, share: float, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Choose the part of a road that is repaired: the same share of every block, and more of the same for a larger one.

    Patches are laid one after the other, the last one of a block in part of its length.

    Args:
        rng: source of sizes, places and directions; their order does not depend on the share.
        length: of the road, m.
        width: of the road, m.
        share: 0 to 0.6.
        shape: rows across the road, from the left, and columns along it.

    Returns:
        Mask of the shape.
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
    mean = float(np.mean(PATCH_LENGTHS) * np.mean(PATCH_WIDTHS))
    count = math.ceil(SPARE * length * width / mean)
    centre = np.column_stack((rng.uniform(0.0, length, count), rng.uniform(0.0, width, count)))
    size = np.column_stack((rng.uniform(*PATCH_LENGTHS, count), rng.uniform(*PATCH_WIDTHS, count)))
    turn = rng.normal(0.0, PATCH_TURN, count)
    cut = rng.random(count) < CUT_SHARE
    size[cut, 0], size[cut, 1] = width * rng.uniform(0.5, 1.2, cut.sum()), rng.uniform(*CUT_WIDTH, cut.sum())
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
