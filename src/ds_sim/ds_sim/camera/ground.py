"""Paints the world as seen from above: road, lines and grass in a pyramid of top-down rasters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_sim.camera.look import Look

RESOLUTION = 0.05
"""Size of a pixel of the finest raster, m; chosen: a line of 0.15 m is three pixels wide."""
LEVELS = 6
"""Number of rasters in the pyramid, each with half the resolution; the coarsest has pixels of 1.6 m, in which a lane
line vanishes."""
MARGIN = 30.0
"""Width of the grass painted around the road, m; beyond it the plane has one colour."""
TEXTURE_SIZE = 512
"""Side of the repeated texture, pixels (25.6 m)."""
LEAD_IN, LEAD_OUT = 10.0, 40.0
"""Length of straight road painted before the start and beyond the end, m, so that neither ends abruptly in view."""
_SHIFT = 6
"""Fractional bits of the coordinates that OpenCV draws with."""


@dataclass(frozen=True)
class Ground:
    """Painted ground plane.

    Attributes:
        levels: rasters (rows, columns, 3 or 4) uint8 RGB or RGBA, finest first, each half the size of the one before;
            row 0 holds the smallest y.
        origin: x and y of the outer corner of pixel (0, 0), m, the same for every level.
        resolution: size of a pixel of the finest level, m.
        outside: colour of the plane beyond the rasters.
    """

    levels: tuple[NDArray[np.uint8], ...]
    origin: tuple[float, float]
    resolution: float
    outside: tuple[int, int, int]

    def pixel_to_world(self, level: int) -> NDArray[np.float64]:
        """Matrix (3, 3) from pixel (column, row, 1) of a level to (x, y, 1) in m; pixel centres are at integers."""
        size = self.resolution * 2.0**level
        return np.array(
            [[size, 0.0, self.origin[0] + 0.5 * size], [0.0, size, self.origin[1] + 0.5 * size], [0.0, 0.0, 1.0]]
        )

    @cached_property
    def atlas(self) -> NDArray[np.uint8]:
        """All levels in one raster (rows, 2 columns, 4), side by side.

        With (x, y) in pixels of the finest level from the outer corner, and s = 1, 1/2, 1/4 ... the scale of a level,
        a point is at (2 columns + s (x - 2 columns), s y): the same formula for every level. There are four channels
        because OpenCV reads them twice as fast as three. Every level has a border in the colour of the outside.
        """
        rows, columns = self.levels[0].shape[:2]
        outside = (*self.outside, 255)
        atlas = np.zeros((rows, 2 * columns, 4), np.uint8)
        start = 0
        for level in self.levels:
            high, wide = level.shape[:2]
            atlas[:, start] = outside
            part = atlas[:high, start : start + wide]
            part[:, :, :3] = level[:, :, :3]
            part[0] = part[-1] = part[:, 0] = part[:, -1] = outside
            atlas[high : high + 1, start : start + wide] = outside
            start += wide
        atlas[:, start:] = outside
        return atlas

    def distance_to_border(self, position: NDArray[np.float64]) -> float:
        """Distance from a point (x, y, ...) to the nearest border of the rasters, m; negative outside."""
        rows, columns = self.levels[0].shape[:2]
        x, y = float(position[0]) - self.origin[0], float(position[1]) - self.origin[1]
        return min(x, y, columns * self.resolution - x, rows * self.resolution - y)

    @property
    def coarsest_scale(self) -> float:
        """Scale of the coarsest level relative to the finest."""
        return 0.5 ** (len(self.levels) - 1)

    @cached_property
    def to_atlas(self) -> NDArray[np.float64]:
        """Matrix (3, 3) from (x, y, 1) in m to (x - 2 columns, y, 1) in pixels of the finest level; see `atlas`."""
        r = self.resolution
        left = self.origin[0] / r + 2 * self.levels[0].shape[1]
        return np.array([[1 / r, 0.0, -left], [0.0, 1 / r, -self.origin[1] / r], [0.0, 0.0, 1.0]])

    @cached_property
    def from_atlas(self) -> NDArray[np.float64]:
        """Inverse of `to_atlas`."""
        return np.asarray(np.linalg.inv(self.to_atlas), np.float64)


def paint_ground(road: Road, look: Look) -> Ground:
    """Paint the ground of a road: grass, asphalt, two solid white edges, one solid yellow centre (paper 3.1.2)."""
    centre, across = _with_leads(road)
    half_width = road.lane_width * 2 / 2
    low = centre.min(axis=0) - half_width - MARGIN
    high = centre.max(axis=0) + half_width + MARGIN
    block = 2 ** (LEVELS - 1)
    columns, rows = (math.ceil((high[i] - low[i]) / RESOLUTION / block) * block for i in (0, 1))
    grass, asphalt = _textures(look)
    raster = _tiled(grass, rows, columns)
    asphalt_raster = _tiled(asphalt, rows, columns)
    lead_in, lead_out = slice(0, 2), slice(-2, None)
    body = slice(1, -1)
    for part in (lead_in, lead_out, body):
        _paint_stretch(raster, asphalt_raster, centre[part] - low, across[part], half_width, look)
    levels = [raster]
    while len(levels) < LEVELS:
        fine = levels[-1]
        levels.append(cv2.resize(fine, (fine.shape[1] // 2, fine.shape[0] // 2), interpolation=cv2.INTER_AREA))
    outside = tuple(int(round(v)) for v in grass.reshape(-1, 3).mean(axis=0))
    return Ground(
        levels=tuple(levels),
        origin=(float(low[0]), float(low[1])),
        resolution=RESOLUTION,
        outside=(outside[0], outside[1], outside[2]),
    )


def _with_leads(road: Road) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centre line and unit vectors to the right, both (n + 2, 2), extended straight at either end."""
    across = (road.right_edge - road.points) / road.lane_width
    ahead = np.stack((-across[:, 1], across[:, 0]), axis=1)
    start = road.points[0] - LEAD_IN * ahead[0]
    end = road.points[-1] + LEAD_OUT * ahead[-1]
    return np.vstack((start, road.points, end)), np.vstack((across[:1], across, across[-1:]))


def _paint_stretch(
    raster: NDArray[np.uint8],
    asphalt: NDArray[np.uint8],
    centre: NDArray[np.float64],
    across: NDArray[np.float64],
    half_width: float,
    look: Look,
) -> None:
    """Paint one stretch of road into the raster; `centre` is relative to the raster's corner, m."""

    def pixels(offset: float) -> NDArray[np.int32]:
        return np.round(((centre + offset * across) / RESOLUTION - 0.5) * (1 << _SHIFT)).astype(np.int32)

    mask = np.zeros(raster.shape[:2], np.uint8)
    surface = np.concatenate((pixels(half_width), pixels(-half_width)[::-1]))
    cv2.fillPoly(mask, [surface], 255, lineType=cv2.LINE_8, shift=_SHIFT)
    cv2.copyTo(asphalt, mask, raster)
    thickness = max(1, round(look.line_width / RESOLUTION))
    inset = half_width - look.line_width / 2
    for offset, colour in ((inset, look.edge_line), (-inset, look.edge_line), (0.0, look.centre_line)):
        cv2.polylines(raster, [pixels(offset)], False, colour, thickness, cv2.LINE_AA, _SHIFT)


@lru_cache(maxsize=8)
def _textures(look: Look) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Seamless textures of grass and asphalt, (TEXTURE_SIZE, TEXTURE_SIZE, 3) each."""
    rng = np.random.default_rng(look.grain_seed)
    grass = _texture(rng, look.grass, look.grass_grain, (1.0, 6.0))
    if look.relief > 0.0:
        grass = _shaded(grass, look)
    return grass, _texture(rng, look.asphalt, look.asphalt_grain, (0.0, 10.0))


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


def _tiled(texture: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    repeats = (math.ceil(rows / TEXTURE_SIZE), math.ceil(columns / TEXTURE_SIZE), 1)
    return np.ascontiguousarray(np.tile(texture, repeats)[:rows, :columns])
