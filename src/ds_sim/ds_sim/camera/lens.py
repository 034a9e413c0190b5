"""Maps pixels of a camera to rays."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.spec import CameraSpec

_NEWTON_STEPS = 8
"""Chosen: the start is within 1e-4 of the root, three steps reach the last digit, and more cost nothing."""


def rays(spec: CameraSpec, columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions (right, down, forward) of the rays through pixels, (3, ...).

    Rays of a pinhole have forward = 1, those of a wide-angle lens have length 1. In both cases a pixel is
    1 / focal length wide at distance 1 along its ray: exactly for the pinhole, within a few percent for the lens.

    Args:
        spec: camera.
        columns: pixel columns, broadcast with `rows`; fractions allowed.
        rows: pixel rows.
    """
    k = spec.intrinsics
    right, down = np.broadcast_arrays((columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1])
    if spec.lens == "pinhole":
        return np.stack((right, down, np.ones_like(right)))
    distorted = np.hypot(right, down)
    undistorted = _undistorted_radius(spec, distorted)
    stretch = np.where(distorted > 0.0, undistorted / np.maximum(distorted, 1e-12), 1.0)
    forward = 1.0 / np.sqrt(1.0 + undistorted**2)
    return np.stack((right * stretch * forward, down * stretch * forward, forward))


def _undistorted_radius(spec: CameraSpec, distorted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radius in a pinhole image for a radius in the lens image, by Newton's method from the equidistant model."""
    k1, k2, _, _, k3, k4, k5, k6 = spec.distortion
    above, below = np.polynomial.Polynomial([1, k1, k2, k3]), np.polynomial.Polynomial([1, k4, k5, k6])
    above_slope, below_slope = above.deriv(), below.deriv()
    radius = np.tan(np.minimum(distorted, 1.5))
    for _ in range(_NEWTON_STEPS):
        t = radius**2
        a, b = above(t), below(t)
        slope = a / b + 2 * t * (above_slope(t) * b - a * below_slope(t)) / b**2
        radius = radius - (radius * a / b - distorted) / slope
    return np.asarray(radius)


@lru_cache(maxsize=32)
def sample_rays(spec: CameraSpec, samples: int) -> NDArray[np.float32]:
    """Rays of a whole image, with `samples` rays stacked vertically in every pixel, (samples, 3, rows * columns)."""
    columns = np.arange(spec.width, dtype=np.float64)
    rows = np.arange(spec.height_px, dtype=np.float64)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    table = np.stack([rays(spec, columns[None, :], (rows + offset)[:, None]).reshape(3, -1) for offset in offsets])
    return table.astype(np.float32)


def components(
    rays: NDArray[np.float32], axis: Sequence[float], out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Components of rays along an axis, (...): scalar products without BLAS, which rounds by the type of processor.

    Args:
        rays: (3, ...).
        axis: three numbers, which are rounded to single precision.
        out: memory for the result.
    """
    first, second, third = axis
    out = np.multiply(rays[0], np.float32(first), out)
    cv2.scaleAdd(rays[1], second, out, out)
    cv2.scaleAdd(rays[2], third, out, out)
    return out
