# SPDX-License-Identifier: Apache-2.0
"""Models the image sensor: point spread, response curve, noise and latency."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.spec import CameraSpec

_NOISE_MARGIN = 64


class Sensor:
    """Converts rendered scenes to delivered images, for one run.

    Args:
        spec: camera.
        rng: source of the noise.
        rows: first row and end of the rows that are delivered; all rows if omitted. The others are zero.
    """

    def __init__(self, spec: CameraSpec, rng: np.random.Generator, rows: tuple[int, int] | None = None) -> None:
        self._spec = spec
        self._rng = rng
        self._rows = slice(*(rows or (0, spec.height_px)))
        levels = np.arange(256) / 255.0
        self._response = np.clip(255.0 * (spec.gain * levels) ** spec.gamma, 0, 255).round().astype(np.uint8)
        self._is_linear = np.array_equal(self._response, np.arange(256))
        self._noise: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None
        if spec.noise > 0.0:
            shape = (spec.height_px + _NOISE_MARGIN, spec.width + _NOISE_MARGIN, 3)
            plate = rng.standard_normal(shape)
            if spec.noise_blur > 0.0:
                plate = np.asarray(cv2.GaussianBlur(plate, (0, 0), spec.noise_blur))
            if spec.noise_colour < 1.0:
                grey = plate[:, :, 0] * np.sqrt(1 - spec.noise_colour**2)
                plate *= spec.noise_colour
                plate += cv2.merge((grey, grey, grey))  # NumPy is slow where it repeats numbers within a pixel
            plate *= spec.noise / plate.std()
            signed = np.rint(plate, plate).astype(np.int16)
            # Bytes that are added or taken away saturate as signed noise does, and are much faster.
            self._noise = (signed.clip(0, 255).astype(np.uint8), (-signed).clip(0, 255).astype(np.uint8))
        self._delayed: list[NDArray[np.uint8]] = []
        self._blank = np.broadcast_to(np.zeros(1, np.uint8), (spec.height_px, spec.width, 3))

    def deliver(self, scene: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        """Expose one image and return the one that arrives now, `latency` frames late (at first the very first one).

        Args:
            scene: (rows, columns, 3) uint8 RGB, of which `scene_rows` are read; None for a blank image.
        """
        # A random window of one precomputed noise plate is much cheaper than new noise for each image.
        row, column = (0, 0) if self._noise is None else self._rng.integers(0, _NOISE_MARGIN, 2).tolist()
        self._delayed.append(self._blank if scene is None else self._exposed(scene, row, column))
        if len(self._delayed) > self._spec.latency + 1:
            self._delayed.pop(0)
        return self._delayed[0]

    def _exposed(self, scene: NDArray[np.uint8], row: int, column: int) -> NDArray[np.uint8]:
        """Expose one image, with the window of the noise plate that begins at a row and a column."""
        spec = self._spec
        delivered = np.empty(scene.shape, np.uint8)
        delivered[: self._rows.start] = delivered[self._rows.stop :] = 0
        image, light = delivered[self._rows], scene[self._rows]
        if spec.blur > 0.0:
            first, last = scene_rows(spec, (self._rows.start, self._rows.stop))
            blurred = np.asarray(cv2.GaussianBlur(scene[first:last], (0, 0), spec.blur), np.uint8)
            light = blurred[self._rows.start - first : self._rows.stop - first]
        if not self._is_linear:
            light = cv2.LUT(light, self._response, image)
        if self._noise is not None:
            rows = slice(self._rows.start + row, self._rows.stop + row)
            more, less = (plate[rows, column : column + spec.width] for plate in self._noise)
            light = cv2.subtract(cv2.add(light, more, image), less, image)
        if light is not image:
            image[:] = light
        delivered.setflags(write=False)
        return delivered


def scene_rows(spec: CameraSpec, rows: tuple[int, int]) -> tuple[int, int]:
    """First row and end of the rows of a scene on which some rows of the delivered image depend."""
    if spec.blur <= 0.0:
        return rows
    # OpenCV's kernel for bytes ends at three standard deviations.
    reach = math.ceil(3.0 * spec.blur) + 1
    return max(rows[0] - reach, 0), min(rows[1] + reach, spec.height_px)
