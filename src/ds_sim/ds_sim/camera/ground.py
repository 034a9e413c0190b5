# SPDX-License-Identifier: Apache-2.0
"""Paints the world as seen from above: road, lines and grass in a pyramid of top-down rasters."""

from __future__ import annotations

import math
import threading

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road import Road
from ds_road.geometry import arc_lengths
from ds_sim.camera.atlas import TEXTURE_SIZE, TILE, AtlasMemory, Ground, textures
from ds_sim.camera.spec import Look
from ds_sim.camera.surface import LEAD_IN, LEAD_OUT, RESOLUTION, SURFACE_CONDITIONS, Canvas, Strip, Surface
from ds_sim.conditions.model import DEFAULT, Conditions

LEVELS = 6
"""Number of rasters in the pyramid, each with half the resolution; the coarsest has pixels of 1.6 m, in which a lane
line vanishes."""
LAZY_LEVELS = 2
"""Number of rasters that are painted where they are looked at; chosen: the others, an eighth of the finest together,
are seen nearly whole."""
MARGIN = 30.0
"""Width of the grass painted around the road, m; beyond it the plane has one colour."""
_SHIFT = 6
"""Fractional bits of the coordinates that OpenCV draws with."""
_LINE_REACH = 4
"""Pixels beyond the half of a line's thickness that drawing may touch: anti-aliasing, and rounding."""


class _Masks(threading.local, AtlasMemory):
    """Memory of a thread for masks of zeros; whoever writes on one makes it zero again."""


_MASKS = _Masks()


def paint_ground(
    road: Road,
    look: Look,
    memory: AtlasMemory | None = None,
    *,
    conditions: Conditions = DEFAULT,
    rng: np.random.Generator | None = None,
) -> Ground:
    """Paint the ground of a road: grass, asphalt, two solid white edges, one solid yellow centre (paper 3.1.2).

    Args:
        road: road to paint.
        look: colours and textures.
        memory: see `Ground`.
        conditions: wear, shadows and pavement.
        rng: what is random about those; the same for every road if omitted.
    """
    surface = None
    if SURFACE_CONDITIONS & conditions.changed.keys():
        source = rng or np.random.default_rng(0)
        surface = Surface(conditions, look, source)
    centre, across = with_leads(road, LEAD_IN, LEAD_OUT)
    low = centre.min(axis=0) - road.half_width - MARGIN
    high = centre.max(axis=0) + road.half_width + MARGIN
    block = 2 ** (LEVELS - 1)
    columns, rows = (math.ceil((high[i] - low[i]) / RESOLUTION / block) * block for i in (0, 1))
    texture = textures(look, LEVELS)
    ground = Ground(
        (rows, columns),
        origin=(float(low[0]), float(low[1])),
        resolution=RESOLUTION,
        outside=texture.outside,
        texture=texture.grass,
        lazy_levels=LAZY_LEVELS,
        memory=memory,
    )
    lead_in, lead_out = slice(0, 2), slice(-2, None)
    body = slice(1, -1)
    beside = surface.reach if surface else 0.0
    reach = (road.half_width + beside) / RESOLUTION + look.line_width / RESOLUTION / 2 + _LINE_REACH
    stretches = [
        (part, _touched_tiles(ground, (centre[part] - low) / RESOLUTION, reach)) for part in (lead_in, lead_out, body)
    ]
    touched = np.logical_or.reduce([tiles for _, tiles in stretches])
    raster = ground.open_tiles(touched)
    mask = _MASKS.array(ground.shape)
    asphalt = surface.pavement(texture.asphalt) if surface else texture.asphalt
    strip = Strip(centre - low, across, road.half_width, road.has_centre_line)
    for part, tiles in stretches:
        canvas = Canvas(raster, mask, list(ground.boxes(tiles)))
        _paint_stretch(canvas, asphalt, strip.part(part), None if surface else look)
    if surface:
        surface.draw(Canvas(raster, mask, list(ground.boxes(touched))), strip)
    ground.close_tiles(touched)
    return ground


def with_leads(road: Road, lead_in: float, lead_out: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centre line and unit vectors to the right, both (n + 2, 2), extended straight by lengths, m, at either end."""
    across = (road.right_edge - road.points) / road.half_width
    ahead = np.stack((-across[:, 1], across[:, 0]), axis=1)
    start = road.points[0] - lead_in * ahead[0]
    end = road.points[-1] + lead_out * ahead[-1]
    return np.vstack((start, road.points, end)), np.vstack((across[:1], across, across[-1:]))


def _touched_tiles(ground: Ground, line: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
    """Tiles of the finest level within `reach` of a line, and perhaps some more; both in pixels of that level."""
    along = arc_lengths(line)
    stations = np.linspace(0.0, along[-1], math.ceil(along[-1] / TILE) * 2 + 1)
    points = np.stack([np.interp(stations, along, line[:, i]) for i in (0, 1)], axis=1)
    # Stations are at most half a tile apart, so that every point of the line is within a quarter of a tile of one.
    extent = reach + TILE / 4
    first = np.floor((points - extent) / TILE).astype(int).clip(0)
    last = np.floor((points + extent) / TILE).astype(int)
    tiles = np.zeros(ground.tiles_shape, np.bool_)
    for (left, top), (right, bottom) in zip(first.tolist(), last.tolist(), strict=True):
        tiles[top : bottom + 1, left : right + 1] = True
    return tiles


def _paint_stretch(canvas: Canvas, asphalt: NDArray[np.uint8], strip: Strip, look: Look | None) -> None:
    """Paint one stretch of road; without a look no lines are painted."""

    def pixels(offset: float) -> NDArray[np.int32]:
        points = strip.centre + offset * strip.across
        return np.round((points / RESOLUTION - 0.5) * (1 << _SHIFT)).astype(np.int32)

    surface = np.concatenate((pixels(strip.half_width), pixels(-strip.half_width)[::-1]))
    cv2.fillPoly(canvas.mask, [surface], 255, lineType=cv2.LINE_8, shift=_SHIFT)
    for box in canvas.boxes:
        top, left = box.top % TEXTURE_SIZE, box.left % TEXTURE_SIZE
        texture = asphalt[top : top + box.bottom - box.top, left : left + box.right - box.left]
        part = box.of(canvas.mask)
        cv2.copyTo(texture, part, box.of(canvas.raster))
        part[:] = 0
    if look is None:
        return
    thickness = max(1, round(look.line_width / RESOLUTION))
    for offset, colour in strip.lines(look):
        cv2.polylines(canvas.raster, [pixels(offset)], False, (*colour, 255), thickness, cv2.LINE_AA, _SHIFT)
