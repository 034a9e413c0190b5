"""Moves the lane of a photograph to where a simulated image shows it, row by row.

Paired photographs still show the lane a few pixels elsewhere. Aligned ones show it at the same place in the
distribution as the simulator does, so a discriminator learns nothing about translated images from where lines are.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ds_driver.sim2real.lane.lane_pairs import HEIGHTS

NARROWEST = 0.05
"""Narrowest lane whose width is matched, in widths of the picture; chosen: farther away both lines are a few pixels."""
MOVE_DEGREE = 2
"""Degree of the polynomial of a line's move over the rows; chosen: a shift, a turn and a bend."""
STRETCH = 1.5
"""Largest factor by which a row is stretched or squeezed; chosen: surroundings still look like photographs."""


def align_lane(
    photograph: NDArray[np.uint8], shown: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Shift and stretch the rows of a photograph so that its lane is where another image has it.

    Args:
        photograph: (rows, columns, 3) uint8 RGB.
        shown: (2 * heights,) where it shows the lines, from `ds_driver.sim2real.lane.lane_pairs.lane_shapes`.
        wanted: the same of the other image.

    Returns:
        (rows, columns, 3) uint8 RGB; what it does not show is mirrored at its sides.
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
    return np.asarray(
        cv2.remap(
            photograph, source.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT_101,
        ),
        np.uint8,
    )  # fmt: skip
