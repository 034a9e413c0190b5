# SPDX-License-Identifier: Apache-2.0
"""Pairs simulated images with photographs that show the lane alike, and aligns these row by row.

CycleGAN gives translated images the distribution of the photographs, also in where the lines are: where simulated roads
are straight and the real track is not, it would bend lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ds_driver.sim2real.generator import Sim2RealError
from ds_driver.sim2real.lane_view import BOUND, find_lines, lane_borders
from ds_driver.sim2real.settings import FEWEST

HEIGHTS = (0.25, 0.35, 0.45, 0.62, 0.8, 0.99)
"""Rows at which lines are compared, as shares of the height; chosen: from the car to where a lane is a few pixels."""
FIRST_ROW = 0.18
"""First row in which lines are looked for, as a share of the height; chosen: above it both lines are a few pixels."""
LEAST_ROWS, LEAST_SPAN = 0.05, 0.1
"""Least number and span of the rows with a line, as shares of the height; chosen: two dashes of a centre line."""
DEGREES = ((0.5, 3), (0.3, 2), (0.0, 1))
"""Span of the rows with a line -> degree of the polynomial through it; chosen: dashes nearby do not tell a bend."""
NEIGHBOURS = 10
"""Photographs per simulated image; chosen: enough for a discriminator to see different ones."""
NARROWEST = 0.05
"""Narrowest lane whose width is matched, in widths of the picture; chosen: farther away both lines are a few pixels."""
MOVE_DEGREE = 2
"""Degree of the polynomial of a line's move over the rows; chosen: a shift, a turn and a bend."""
STRETCH = 1.5
"""Largest factor by which a row is stretched or squeezed; chosen: surroundings still look like photographs."""


@dataclass(frozen=True, kw_only=True)
class LanePairs:
    """Photographs for each simulated image; `apart` is the median distance of lines, in widths of the picture."""

    simulated: NDArray[np.int64]  # (n,) indices of the simulated images that show both lines
    photographs: NDArray[np.int64]  # (n, `NEIGHBOURS` or fewer) indices of the photographs whose lane is nearest
    simulated_lanes: NDArray[np.float64]  # (n, 2 * heights) from `lane_shapes`
    photographed_lanes: NDArray[np.float64]  # (m, 2 * heights) of all photographs; NaN if they do not show both lines
    apart: float

    @property
    def warning(self) -> str | None:
        """Say that photographs are unlike the simulated images, if they are."""
        if self.apart <= BOUND:
            return None
        return (
            f"the photographs that are most like a simulated image show lines {self.apart:.2f} of the picture's width "
            f"apart from its, expected at most {BOUND:g}: the generator will move lines; take more photographs, on "
            "straights and in bends of both directions"
        )


def lane_shapes(images: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Measure the columns of both lines at `HEIGHTS` in images for a generator, (n, rows, columns, 3) uint8 RGB.

    They are (n, 2 * heights), in widths of the picture, the yellow line first; NaN in images that do not show both.
    """
    shapes = [_lane_shape(lane_borders(find_lines(image)), image.shape[1]) for image in images]
    return np.stack(shapes) if shapes else np.empty((0, 2 * len(HEIGHTS)))


def _lane_shape(borders: NDArray[np.float64], columns: int) -> NDArray[np.float64]:
    rows = len(borders)
    first, at = round(FIRST_ROW * rows), np.array(HEIGHTS) * rows
    shape = np.full((2, len(HEIGHTS)), np.nan)
    for side in (0, 1):
        visible = first + np.flatnonzero(np.isfinite(borders[first:, side]))
        span = np.ptp(visible) / rows if visible.size else 0.0
        if visible.size < LEAST_ROWS * rows or span < LEAST_SPAN:
            break
        degree = next(degree for least, degree in DEGREES if span >= least)
        line = Polynomial.fit(visible, borders[visible, side], degree)
        # A line that left the picture is not followed any further.
        shape[side] = (line(at) / columns).clip(-0.25, 1.25)
    return shape.ravel()


def pair_lanes(simulated: NDArray[np.uint8], photographs: NDArray[np.uint8]) -> LanePairs:
    """Pair images as `lane_shapes` takes them by their lanes; a Sim2RealError if too few show both lines."""
    shapes = [lane_shapes(images) for images in (simulated, photographs)]
    visible = [np.flatnonzero(np.isfinite(part).all(axis=1)) for part in shapes]
    for name, with_lines, part in zip(("simulated images", "photographs"), visible, shapes, strict=True):
        if len(with_lines) < FEWEST:
            raise Sim2RealError(
                f"{len(with_lines)} of {len(part)} {name} show both lines of the lane, expected at least {FEWEST}: "
                "take more photographs from the right lane"
            )
    tree = KDTree(shapes[1][visible[1]])
    distance, nearest = tree.query(shapes[0][visible[0]], k=min(NEIGHBOURS, len(visible[1])))
    apart = float(np.median(distance) / np.sqrt(shapes[0].shape[1]))
    return LanePairs(
        simulated=visible[0],
        photographs=visible[1][nearest],
        simulated_lanes=shapes[0][visible[0]],
        photographed_lanes=shapes[1],
        apart=apart,
    )


def align_lane(
    photograph: NDArray[np.uint8], shown: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Shift and stretch the rows of a photograph so that its lane is where another image has it.

    The photograph is (rows, columns, 3) uint8 RGB, as is the result, mirrored at the sides where it ends. `shown` and
    `wanted`, (2 * heights,) from `lane_shapes`, are the lines of the photograph and of the other image.
    """
    rows, columns = photograph.shape[:2]
    at = np.array(HEIGHTS) * rows
    every = np.arange(rows, dtype=np.float64)
    # Above the highest measured row lines are not known: all of it moves as that row does.
    measured = np.maximum(every, at[0])
    from_lines = np.stack([np.interp(measured, at, side) for side in shown.reshape(2, -1)])
    moves = (wanted - shown).reshape(2, -1)
    # A smooth move keeps the smooth edges of a line; its values where lines have left the picture are guesses.
    to_lines = from_lines + np.stack([Polynomial.fit(at, move, MOVE_DEGREE)(measured) for move in moves])
    width, wanted_width = from_lines[1] - from_lines[0], to_lines[1] - to_lines[0]
    wide = np.minimum(width, wanted_width) > NARROWEST
    stretch = np.divide(width, wanted_width, out=np.ones(rows), where=wide).clip(1 / STRETCH, STRETCH)
    middle, wanted_middle = from_lines.mean(axis=0), to_lines.mean(axis=0)
    x = np.arange(columns) / columns
    source = (middle[:, None] + stretch[:, None] * (x - wanted_middle[:, None])) * columns
    y = np.broadcast_to(every[:, None], source.shape)
    x_map, y_map = source.astype(np.float32), y.astype(np.float32)
    aligned = cv2.remap(photograph, x_map, y_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(aligned, np.uint8)
