# SPDX-License-Identifier: Apache-2.0
"""Statistics of camera images: brightness, contrast, sharpness, noise and its spectrum.

All are computed from the luma (ITU-R BT.601) of 8-bit RGB images and serve to compare cameras across scenes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

BLOCK = 8
"""Side of the blocks in which noise is measured, px; as in JPEG, and small enough to lie on one surface."""
QUIETEST = 0.1
"""Share of the blocks with the lowest variance, which are assumed to contain noise only."""


@dataclass(frozen=True, kw_only=True)
class ImageStatistics:
    """Statistics of one image.

    Attributes:
        brightness: mean luma, grey levels.
        contrast: standard deviation of luma, grey levels.
        sharpness: standard deviation of the Laplacian (4 neighbours) over the contrast; dimensionless.
        noise: standard deviation within the quietest blocks after subtracting a fitted plane, grey levels.
        noise_fineness: share of that noise's power above half the Nyquist frequency along rows or columns;
            48 / 61 = 0.79 for white noise (64 DCT terms minus a plane), less for filtered noise.
    """

    brightness: float
    contrast: float
    sharpness: float
    noise: float
    noise_fineness: float


def image_statistics(image: NDArray[np.uint8]) -> ImageStatistics:
    """Compute the statistics of an image.

    Args:
        image: (rows, columns, 3) uint8 RGB, at least 16 x 16 pixels.

    Raises:
        ValueError: the image has another shape or type.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or min(image.shape[:2]) < 2 * BLOCK:
        raise ValueError(
            f"image of shape {image.shape} and type {image.dtype}: expected (rows, columns, 3) uint8, 16 x 16 or more"
        )
    luma = image.astype(np.float64) @ (0.299, 0.587, 0.114)
    inner = cv2.Laplacian(luma, cv2.CV_64F)[1:-1, 1:-1]
    contrast = float(luma.std())
    noise, fineness = _noise(luma)
    return ImageStatistics(
        brightness=float(luma.mean()),
        contrast=contrast,
        sharpness=float(inner.std()) / contrast if contrast > 0.0 else 0.0,
        noise=noise,
        noise_fineness=fineness,
    )


def _noise(luma: NDArray[np.float64]) -> tuple[float, float]:
    """Standard deviation and share of high frequencies in the quietest blocks."""
    rows, columns = (size // BLOCK for size in luma.shape)
    tiles = luma[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2)
    blocks = tiles.reshape(-1, BLOCK, BLOCK)
    # Blocks at either end of the range are clipped, not quiet.
    level = blocks.mean(axis=(1, 2))
    inside = blocks[(level > 20.0) & (level < 235.0)]
    if not len(inside):
        return 0.0, 0.0
    step = np.arange(BLOCK) - (BLOCK - 1) / 2
    basis = np.stack(
        (np.ones((BLOCK, BLOCK)), *(v / np.sqrt((v**2).mean()) for v in np.meshgrid(step, step)))
    ).reshape(3, -1) / BLOCK  # fmt: skip
    flat = inside.reshape(len(inside), -1)
    residual = flat - flat @ basis.T @ basis
    variance = (residual**2).sum(axis=1) / (BLOCK**2 - 3)
    quiet = np.argsort(variance, kind="stable")[: max(1, round(QUIETEST * len(variance)))]
    spectrum = np.zeros((BLOCK, BLOCK))
    for index in quiet:
        spectrum += cv2.dct(residual[index].reshape(BLOCK, BLOCK)) ** 2
    fine = spectrum[BLOCK // 2 :].sum() + spectrum[: BLOCK // 2, BLOCK // 2 :].sum()
    total = spectrum.sum()
    return float(np.sqrt(variance[quiet].mean())), float(fine / total) if total > 0.0 else 0.0


def percentiles(
    statistics: list[ImageStatistics], shares: tuple[float, ...] = (5, 50, 95)
) -> dict[str, tuple[float, ...]]:
    """Percentiles of each statistic over many images, by name of the statistic."""
    rows = np.array([list(asdict(s).values()) for s in statistics])
    names = [field.name for field in fields(ImageStatistics)]
    return {
        name: tuple(float(v) for v in np.percentile(rows[:, i], shares))
        for i, name in enumerate(names)
    }  # fmt: skip
