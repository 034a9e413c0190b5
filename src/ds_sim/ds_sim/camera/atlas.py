# SPDX-License-Identifier: Apache-2.0
"""Pyramid of rasters of the ground, painted where it is looked at, and its seamless textures of grass and asphalt."""

from __future__ import annotations

import math
import mmap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.spec import Look

TEXTURE_SIZE = 512
"""Side of a texture, pixels of the finest raster (25.6 m)."""
TILE = 64
"""Side of a tile in pixels of the finest level (3.2 m); on every level a tile covers the same ground."""


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


class AtlasMemory:
    """Memory for the ground of one road after another: only its first use costs page faults.

    A page takes memory once it is written. Huge pages are declined, as a single tile touches many.
    """

    def __init__(self) -> None:
        self._pages = mmap.mmap(-1, mmap.PAGESIZE)

    def array(self, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """Return an array (uint8) in the place of the one before, with its content; zeros where none was."""
        size = math.prod(shape)
        if len(self._pages) < size:
            self._pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
            if hasattr(mmap, "MADV_NOHUGEPAGE"):
                self._pages.madvise(mmap.MADV_NOHUGEPAGE)
        return np.frombuffer(self._pages, np.uint8, size).reshape(shape)


class Box(NamedTuple):
    """Part of a raster, pixels; `bottom` and `right` are the first beyond."""

    top: int
    left: int
    bottom: int
    right: int

    def of(self, raster: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """View of this part of a raster."""
        return raster[self.top : self.bottom, self.left : self.right]


class Ground:
    """Painted ground plane: a pyramid of rasters, each with half the resolution of the one before.

    All levels lie side by side in one raster, `atlas`, (rows, 2 columns, 4) uint8 RGBA. With (x, y) in pixels of the
    finest level from the outer corner, and s = 1, 1/2, 1/4 ... the scale of a level, a point is at
    (2 columns + s (x - 2 columns), s y): the same formula for every level. There are four channels because OpenCV reads
    them twice as fast as three. Every level has a border in the colour of the outside.

    The atlas of a road has some 90 MB, of which a drive sees a part. The fine levels, `lazy_levels`, are therefore
    painted tile by tile by `reveal`, and pages of the atlas that are never painted take no memory.

    Args:
        shape: rows and columns of the finest level; divisible by 2 ** (number of levels - 1).
        origin: x and y of the outer corner of pixel (0, 0), m, the same for every level; row 0 holds the smallest y.
        resolution: size of a pixel of the finest level, m.
        outside: colour of the plane beyond the rasters.
        texture: what covers the plane where nothing else is painted, (n, n, 4) uint8 RGBA for each level, repeated
            from the outer corner; n is a multiple of `TILE` on the finest level.
        lazy_levels: number of levels, finest first, that are painted by `reveal`.
        memory: memory to paint in, which ends the use of any ground painted in it before; its own if omitted.

    Attributes:
        tiles_shape: number of rows and columns of tiles.
        coarsest_scale: scale of the coarsest level relative to the finest.
        corner: pixels of the finest level to subtract from x and y for a place in the atlas less 2 columns.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        *,
        origin: tuple[float, float],
        resolution: float,
        outside: tuple[int, int, int],
        texture: Sequence[NDArray[np.uint8]],
        lazy_levels: int,
        memory: AtlasMemory | None = None,
    ) -> None:
        rows, columns = shape
        self.shape = shape
        self.origin = origin
        self.resolution = resolution
        self.outside = outside
        self.lazy_levels = lazy_levels
        self.coarsest_scale = 0.5 ** (len(texture) - 1)
        self.corner = origin[0] / resolution + 2 * columns, origin[1] / resolution
        self.atlas = (memory or AtlasMemory()).array((rows, 2 * columns, 4))
        self._texture = texture
        self._starts = [2 * columns - (2 * columns >> level) for level in range(len(texture) + 1)]
        self._rasters = tuple(
            self.atlas[: rows >> level, start : start + (columns >> level)]
            for level, start in enumerate(self._starts[:-1])
        )
        self.tiles_shape = (math.ceil(rows / TILE), math.ceil(columns / TILE))
        self._is_painted = np.zeros((lazy_levels, *self.tiles_shape), np.bool_)
        # Where there are tiles to close, the levels beyond follow then.
        for level in range(lazy_levels, lazy_levels + 1 if lazy_levels else len(texture)):
            self._cover(level, 0, 0, *self._rasters[level].shape[:2])

    @property
    def levels(self) -> tuple[NDArray[np.uint8], ...]:
        """All rasters, painted in full, (rows, columns, 4) each, finest first: parts of the atlas."""
        for level in range(self.lazy_levels):
            self._reveal_tiles(level, 0, self.tiles_shape[0] - 1, 0, self.tiles_shape[1] - 1)
        return self._rasters

    def distance_to_border(self, x: float, y: float) -> float:
        """Distance from a point to the nearest border of the rasters, m; negative outside."""
        x, y = x - self.origin[0], y - self.origin[1]
        return min(x, y, self.shape[1] * self.resolution - x, self.shape[0] * self.resolution - y)

    def reveal(self, level: int, low: tuple[float, float], high: tuple[float, float]) -> None:
        """Paint what is missing of one of the lazy levels within a box from the smallest to the largest x and y, m."""
        # A bilinear sample reads one pixel further; a second one covers rounding.
        margin = 2.0 * self.resolution * 2.0**level
        size = TILE * self.resolution
        left, top = ((low[i] - margin - self.origin[i]) / size for i in (0, 1))
        right, bottom = ((high[i] + margin - self.origin[i]) / size for i in (0, 1))
        rows, columns = self.tiles_shape
        first, last = min(max(math.floor(top), 0), rows - 1), min(max(math.floor(bottom), 0), rows - 1)
        begin, end = min(max(math.floor(left), 0), columns - 1), min(max(math.floor(right), 0), columns - 1)
        self._reveal_tiles(level, first, last, begin, end)

    def _reveal_tiles(self, level: int, first: int, last: int, begin: int, end: int) -> None:
        """Paint the missing tiles of a lazy level in some rows (first to last) and columns (begin to end) of tiles."""
        is_painted = self._is_painted[level, first : last + 1, begin : end + 1]
        if is_painted.all():
            return
        for box in self.boxes(~is_painted, (first, begin)):
            self._cover(level, *(v >> level for v in box))
        is_painted[:] = True

    def open_tiles(self, tiles: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Cover some tiles of the finest level with the texture, to be drawn on; `close_tiles` ends the drawing.

        Returns that raster, (rows, columns, 4), of which the rest may be unpainted.
        """
        for box in self.boxes(tiles):
            self._cover(0, *box)
        return self._rasters[0]

    def close_tiles(self, tiles: NDArray[np.bool_]) -> None:
        """Carry what was drawn on some tiles of the finest level over to the other levels."""
        rasters = self._rasters
        for box in self.boxes(tiles):
            top, left, bottom, right = box
            fine = box.of(rasters[0])
            for raster in rasters[1 : self.lazy_levels + 1]:
                top, left, bottom, right = top >> 1, left >> 1, bottom >> 1, right >> 1
                fine = halved(fine, raster[top:bottom, left:right])
        for level in range(self.lazy_levels + 1, len(rasters)):
            halved(rasters[level - 1], rasters[level])
            self._draw_border(level, 0, 0, *rasters[level].shape[:2])
        self._is_painted |= tiles

    def boxes(self, tiles: NDArray[np.bool_], corner: tuple[int, int] = (0, 0)) -> Iterator[Box]:
        """Parts of the finest level that some tiles cover; none crosses a period of the texture.

        The corner is row and column of the first of them among all tiles.
        """
        period = self._texture[0].shape[1] // TILE
        starts_period = (np.arange(1, tiles.shape[1]) + corner[1]) % period == 0
        starts = tiles.copy()
        starts[:, 1:] &= ~tiles[:, :-1] | starts_period
        ends = tiles.copy()
        ends[:, :-1] &= ~tiles[:, 1:] | starts_period
        for (row, start), end in zip((np.argwhere(starts) + corner).tolist(), ends.nonzero()[1].tolist(), strict=True):
            bottom, right = min((row + 1) * TILE, self.shape[0]), min((corner[1] + end + 1) * TILE, self.shape[1])
            yield Box(row * TILE, start * TILE, bottom, right)

    def _cover(self, level: int, top: int, left: int, bottom: int, right: int) -> None:
        """Cover a part of a level with the texture, and with the border where it has a part in it.

        The part begins at a tile's corner.
        """
        raster, texture = self._rasters[level], self._texture[level]
        height, width = texture.shape[:2]
        for y in range(top - top % height, bottom, height):
            for x in range(left - left % width, right, width):
                box = Box(max(y, top), max(x, left), min(y + height, bottom), min(x + width, right))
                box.of(raster)[:] = texture[box.top - y : box.bottom - y, box.left - x : box.right - x]
        rows, columns = raster.shape[:2]
        if top == 0 or left == 0 or bottom == rows or right == columns:
            self._draw_border(level, top, left, bottom, right)

    def _draw_border(self, level: int, top: int, left: int, bottom: int, right: int) -> None:
        """Draw the border of a level within a part of it, and the pixels beyond that a sample on it reads."""
        rows, columns = self._rasters[level].shape[:2]
        outside = (*self.outside, 255)
        start = self._starts[level]
        beyond = bottom + 1 if bottom == rows else bottom
        if top == 0:
            self.atlas[0, start + left : start + right] = outside
        if bottom == rows:
            self.atlas[rows - 1 : rows + 1, start + left : start + right] = outside
        if left == 0:
            self.atlas[top:beyond, max(start - 1, 0) : start + 1] = outside
        if right == columns:
            self.atlas[top:beyond, start + columns - 1 : start + columns + 1] = outside
