"""Models the image sensor: point spread, response curve, noise and latency."""

from __future__ import annotations

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
    """

    def __init__(self, spec: CameraSpec, rng: np.random.Generator) -> None:
        self._spec = spec
        self._rng = rng
        levels = np.arange(256) / 255.0
        self._response = np.clip(255.0 * (spec.gain * levels) ** spec.gamma, 0, 255).round().astype(np.uint8)
        self._noise: NDArray[np.int16] | None = None
        if spec.noise > 0.0:
            shape = (spec.height_px + _NOISE_MARGIN, spec.width + _NOISE_MARGIN, 3)
            plate = rng.normal(0.0, 1.0, shape)
            if spec.noise_blur > 0.0:
                plate = np.asarray(cv2.GaussianBlur(plate, (0, 0), spec.noise_blur))
            if spec.noise_colour < 1.0:
                grey = plate[:, :, :1]
                plate = grey * np.sqrt(1 - spec.noise_colour**2) + plate * spec.noise_colour
            self._noise = np.round(plate * (spec.noise / plate.std())).astype(np.int16)
        self._delayed: list[NDArray[np.uint8]] = []

    def deliver(self, scene: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Expose one image and return the one that arrives now, `latency` frames late (at first the very first one)."""
        image = scene
        if self._spec.blur > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self._spec.blur), np.uint8)
        image = np.asarray(cv2.LUT(image, self._response), np.uint8)
        if self._noise is not None:
            # A random window of one precomputed noise plate is much cheaper than new noise for each image.
            row, column = self._rng.integers(0, _NOISE_MARGIN, 2)
            plate = self._noise[row : row + self._spec.height_px, column : column + self._spec.width]
            image = np.asarray(cv2.add(image, plate, dtype=cv2.CV_8U), np.uint8)
        image.setflags(write=False)
        self._delayed.append(image)
        if len(self._delayed) > self._spec.latency + 1:
            self._delayed.pop(0)
        return self._delayed[0]
