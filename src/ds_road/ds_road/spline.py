"""Centripetal Catmull-Rom splines (paper 3.1.1; maxitwo: 20 samples per segment)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SAMPLES_PER_SEGMENT = 20
"""Samples between two control points, both ends included (maxitwo)."""
ALPHA = 0.5
"""Exponent of the knot spacing; 0.5 makes the spline centripetal (maxitwo)."""


def catmull_rom(control_points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample the spline that passes through all but the first and the last control point.

    Args:
        control_points: (n, 2) coordinates, m, n >= 4, no two neighbours equal.

    Returns:
        (20 + 19 (n - 4), 2) points, m; a sample shared by two segments appears once.
    """
    segments = [_segment(control_points[i : i + 4]) for i in range(len(control_points) - 3)]
    return np.vstack([segments[0], *(segment[1:] for segment in segments[1:])])


def _segment(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Segment between the second and the third of four points, by the Barry-Goldman pyramid."""
    knots = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T) ** ALPHA)))
    t = np.linspace(knots[1], knots[2], SAMPLES_PER_SEGMENT)[:, None]
    a = [_interpolate(knots[i], knots[i + 1], p[i], p[i + 1], t) for i in range(3)]
    b = [_interpolate(knots[i], knots[i + 2], a[i], a[i + 1], t) for i in range(2)]
    return _interpolate(knots[1], knots[2], b[0], b[1], t)


def _interpolate(
    start: float, end: float, first: NDArray[np.float64], second: NDArray[np.float64], t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate linearly from `first` at `start` to `second` at `end`."""
    return (end - t) / (end - start) * first + (t - start) / (end - start) * second
