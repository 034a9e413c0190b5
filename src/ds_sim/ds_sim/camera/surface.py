# SPDX-License-Identifier: Apache-2.0
"""Changes a painted road by its conditions: pavement, repair patches, worn lines, shadows across it.

Everything is drawn in linear light, from random numbers that do not depend on the strength of a condition: what a weak
condition covers, a stronger one covers too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_road.geometry import arc_lengths
from ds_sim.camera.atlas import TEXTURE_SIZE, Box
from ds_sim.camera.optics import decode, encode, light_of
from ds_sim.camera.spec import Colour, Look
from ds_sim.conditions.model import Conditions

RESOLUTION = 0.05
"""Size of a pixel of the finest raster, m; chosen: a line of 0.15 m is three pixels wide."""
LEAD_IN, LEAD_OUT = 10.0, 40.0
"""Length of straight road painted before the start and beyond the end, m, so that neither ends abruptly in view."""
SURFACE_CONDITIONS = frozenset(
    {
        "line_contrast",
        "line_cover",
        "line_cover_length",
        "shadow_density",
        "shadow_depth",
        "pavement_reflectance",
        "repair_share",
    }
)
"""Conditions that change the painted ground."""
SHADOW_LENGTH = 2.0
"""Length of a shadow along the road, m; chosen: tree tops beside the road, which merge where several are in a row."""
SHADOW_REACH = 6.0
"""Distance beyond the road's edges that shadows extend, m; chosen: that they seem to come from beside the road."""
MAX_SLANT = 0.8
"""Largest shift of a shadow along the road per distance across it; chosen: nearly 40 degrees."""
_WOBBLE = 0.3
"""Unevenness of a shadow's sides, m; chosen."""
PENUMBRA = 1.0
"""Standard deviation of a shadow's edge, px of the ground: the sun's disc of half a degree, 10 m away, is two wide."""
PATCH_LENGTH = 3.0
"""Length of a repair patch, m; chosen: half a lane wide, as milling machines leave them."""
NEW_ASPHALT = 0.05
"""Reflectance of new asphalt (American Concrete Pavement Association); patches have at most 0.6 of the road's."""
_GRAIN_BLUR = 1.2
"""Standard deviation of the filter on the noise that makes worn paint blotchy, px of the ground; chosen: 6 cm."""
GROUP = 6
"""Pieces in a row of which a share is covered as of all; chosen: shadows then change within 12 m, the view ahead."""
_CAP = 0.75
"""Length beyond half its thickness by which OpenCV's anti-aliased line extends at either end, px, as measured."""
_SHIFT = 6
_Points = NDArray[np.float64]


@dataclass(frozen=True)
class Strip:
    """Road, or a stretch of it, relative to a raster's corner."""

    centre: _Points  # centre line, (n, 2), m
    across: _Points  # unit vectors to the right, (n, 2)
    half_width: float  # m
    two_lanes: bool  # whether there is a centre line

    def part(self, rows: slice) -> Strip:
        """A stretch of it."""
        return replace(self, centre=self.centre[rows], across=self.across[rows])

    def lines(self, look: Look) -> list[tuple[float, Colour]]:
        """Distance to the right of the centre line, m, and colour of each line."""
        inset = self.half_width - look.line_width / 2
        lines = [(inset, look.edge_line), (-inset, look.edge_line), (0.0, look.centre_line)]
        return lines if self.two_lanes else lines[:2]


@dataclass(frozen=True)
class Canvas:
    """What may be drawn on."""

    raster: NDArray[np.uint8]  # (rows, columns, 4) uint8
    mask: NDArray[np.uint8]  # (rows, columns) uint8 of zeros, to which it returns
    boxes: list[Box]  # parts of both

    def masked(self) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32], Box]]:
        """Parts under the mask as linear light (rows, columns, 3), to be changed in place, and the mask, 0 to 1.

        The mask is zero afterwards.
        """
        for box in self.boxes:
            covered = box.of(self.mask)
            columns = np.flatnonzero(covered.max(axis=0))
            if not len(columns):
                continue
            box = Box(box.top, box.left + int(columns[0]), box.bottom, box.left + int(columns[-1]) + 1)
            covered = box.of(self.mask)
            alpha = covered.astype(np.float32)[:, :, None]
            alpha /= np.float32(255.0)
            pixels = box.of(self.raster)
            light = decode(pixels[:, :, :3])
            yield light, alpha, box
            touched = covered > 0
            pixels[touched, :3] = encode(light)[touched]
            covered[:] = 0


class Surface:
    """Draws the conditions of one road on its raster."""

    def __init__(self, conditions: Conditions, look: Look, rng: np.random.Generator) -> None:
        self._conditions = conditions
        self._look = look
        self._rngs = dict(zip(("lines", "grain", "patches", "shadows"), rng.spawn(4), strict=True))
        reflectance = float(light_of(look.asphalt).mean())
        self._reflectance = conditions.pavement_reflectance or reflectance
        self._brighter = self._reflectance / reflectance

    @property
    def reach(self) -> float:
        """Distance beyond the road's edges that is drawn on, m."""
        return SHADOW_REACH if self._conditions.shadow_density else 0.0

    def pavement(self, asphalt: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Pavement of another reflectance, from a texture (n, n, 4)."""
        if self._conditions.pavement_reflectance is None:
            return asphalt
        changed = asphalt.copy()
        own = light_of(self._look.asphalt)
        # Concrete is smoother than asphalt: the brighter, the less grain.
        grain = (decode(asphalt[:, :, :3]) / own) ** np.float32(1.0 / (1.0 + max(math.log2(self._brighter), 0.0)))
        changed[:, :, :3] = encode(grain * own * np.float32(self._brighter))
        return changed

    def draw(self, canvas: Canvas, strip: Strip) -> None:
        """Draw patches, lines and shadows on a paved road with its leads."""
        line = _Line(strip)
        self._draw_patches(canvas, line)
        self._draw_lines(canvas, line)
        self._draw_shadows(canvas, line)

    def _draw_patches(self, canvas: Canvas, line: _Line) -> None:
        share, rng, half_width = self._conditions.repair_share, self._rngs["patches"], line.strip.half_width
        if not share:
            return
        for left in (-1.0, -0.5, 0.0, 0.5):
            sides = (left * half_width, (left + 0.5) * half_width)
            for start, end in pieces(rng, line.regions, PATCH_LENGTH, share):
                outline = np.concatenate((line.part(start, end, sides[0]), line.part(start, end, sides[1])[::-1]))
                cv2.fillPoly(canvas.mask, [outline], 255, lineType=cv2.LINE_AA, shift=_SHIFT)
        darker = min(NEW_ASPHALT / self._reflectance, 0.6)
        for part, alpha, _ in canvas.masked():
            part *= 1.0 - alpha * np.float32(1.0 - darker)

    def _draw_lines(self, canvas: Canvas, line: _Line) -> None:
        c, look, rng = self._conditions, self._look, self._rngs["lines"]
        thickness = max(1, round(look.line_width / RESOLUTION))
        grain = _grain(self._rngs["grain"]) * np.float32(min(c.line_contrast, 1.0 - c.line_contrast))
        for offset, colour in line.strip.lines(look):
            cap = (thickness / 2.0 + _CAP) * RESOLUTION
            for start, end in gaps(pieces(rng, line.regions, c.line_cover_length, c.line_cover), 0.0, line.length):
                low = start + cap if start > 0.0 else start
                high = end - cap if end < line.length else end
                if high > low:
                    points = line.part(low, high, offset)
                    cv2.polylines(canvas.mask, [points], False, 255, thickness, cv2.LINE_AA, _SHIFT)
            light = light_of(colour)
            for part, alpha, box in canvas.masked():
                top, left = box.top % TEXTURE_SIZE, box.left % TEXTURE_SIZE
                rows, columns = part.shape[:2]
                alpha *= np.float32(c.line_contrast) + grain[top : top + rows, left : left + columns, None]
                part += alpha * (light - part)

    def _draw_shadows(self, canvas: Canvas, line: _Line) -> None:
        c, rng, half_width = self._conditions, self._rngs["shadows"], line.strip.half_width
        if not c.shadow_density:
            return
        slant = rng.uniform(-MAX_SLANT, MAX_SLANT)
        offsets = np.arange(-half_width - SHADOW_REACH, half_width + SHADOW_REACH + 0.5, 0.5)
        wobble_rng, cell_rng = rng.spawn(2)
        noise = wobble_rng.normal(0.0, 1.0, (64, len(offsets)))
        smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), sigmaX=1.5, sigmaY=0.01), np.float64)
        waves = smooth * (_WOBBLE / smooth.std())
        for index, (start, end) in enumerate(pieces(cell_rng, line.regions, SHADOW_LENGTH, c.shadow_density)):
            # Both sides share the unevenness, so that the shadow has the same length everywhere.
            shift = slant * offsets + waves[index % len(waves)]
            near, far = line.points(start + shift, offsets), line.points(end + shift, offsets)
            outline = np.concatenate((near, far[::-1]))
            cv2.fillPoly(canvas.mask, [outline], 255, lineType=cv2.LINE_AA, shift=_SHIFT)
        for box in canvas.boxes:
            edges = box.of(canvas.mask)
            if edges.any():
                edges[:] = cv2.GaussianBlur(edges, (0, 0), PENUMBRA, borderType=cv2.BORDER_REPLICATE)
        for part, alpha, _ in canvas.masked():
            part *= 1.0 - alpha * np.float32(c.shadow_depth)


class _Line:
    """Road's centre line by its arc length, in OpenCV's coordinates with fraction bits."""

    def __init__(self, strip: Strip) -> None:
        self.strip = strip
        self._arc = arc_lengths(strip.centre)
        self.length = float(self._arc[-1])
        self.regions = ((0.0, LEAD_IN), (LEAD_IN, self.length - LEAD_OUT), (self.length - LEAD_OUT, self.length))

    def part(self, start: float, end: float, offset: float) -> NDArray[np.int32]:
        """Points from start to end, at a distance to the right."""
        inside = self._arc[(self._arc > start) & (self._arc < end)]
        arcs = np.concatenate(([start], inside, [end]))
        return self.points(arcs, np.full(len(arcs), offset))

    def points(self, arcs: _Points, offsets: _Points) -> NDArray[np.int32]:
        """Points at arc lengths and distances to the right, (n, 2)."""
        points = [
            np.interp(arcs, self._arc, self.strip.centre[:, i])
            + offsets * np.interp(arcs, self._arc, self.strip.across[:, i])
            for i in (0, 1)
        ]
        return np.round((np.stack(points, axis=1) / RESOLUTION - 0.5) * (1 << _SHIFT)).astype(np.int32)


def _grain(rng: np.random.Generator) -> NDArray[np.float32]:
    """Seamless noise with mean 0 within -1 to 1, by which worn paint is blotchy, (TEXTURE_SIZE, TEXTURE_SIZE)."""
    noise = rng.standard_normal((TEXTURE_SIZE, TEXTURE_SIZE), np.float32)
    margin = math.ceil(4 * _GRAIN_BLUR)
    wrapped = cv2.copyMakeBorder(noise, margin, margin, margin, margin, cv2.BORDER_WRAP)
    smooth = cv2.GaussianBlur(wrapped, (0, 0), _GRAIN_BLUR)[margin:-margin, margin:-margin]
    return np.asarray(np.clip(smooth / (2.0 * smooth.std()), -1.0, 1.0), np.float32)


def pieces(
    rng: np.random.Generator, regions: Iterable[tuple[float, float]], length: float, share: float
) -> list[tuple[float, float]]:
    """Choose pieces that cover a share of every region, exactly, and more of the same for a larger share.

    The regions, (start, end) along a line, m, are in order and without gaps; `length` is that of a piece, m. What is
    covered is returned in order, neighbours joined.
    """
    spans: list[tuple[float, float]] = []
    for start, end in regions:
        count = max(1, round((end - start) / length))
        size = (end - start) / count
        wanted = share * count
        for rank, cell in enumerate(_spread(rng, count)):
            part = min(max(wanted - rank, 0.0), 1.0)
            if part > 0.0:
                spans.append((start + cell * size, start + (cell + part) * size))
    joined: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if joined and start - joined[-1][1] < 1e-9:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((start, end))
    return joined


def _spread(rng: np.random.Generator, count: int) -> list[int]:
    """Random order of some cells in which every neighbourhood takes its turn, so that a share is spread out."""
    groups = [rng.permutation(range(first, min(first + GROUP, count))).tolist() for first in range(0, count, GROUP)]
    turns = rng.permutation(len(groups)).tolist()
    return [groups[turn][place] for place in range(GROUP) for turn in turns if place < len(groups[turn])]


def gaps(covered: list[tuple[float, float]], start: float, end: float) -> Iterator[tuple[float, float]]:
    """What some pieces leave of a line from start to end."""
    for low, high in covered:
        if low > start + 1e-9:
            yield start, low
        start = high
    if end > start + 1e-9:
        yield start, end
