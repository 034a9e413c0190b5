"""Translates camera images with a generator, for training data and for driving alike: the same bits in both."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.onnx_backend import onnx_runner
from ds_driver.networks.openvino_backend import openvino_runner
from ds_driver.sim2real.generator_file import StoredGenerator
from ds_driver.sim2real.generator_onnx import generator_to_onnx
from ds_driver.sim2real.window import Sim2RealError, prepare, resize
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

BACKENDS = ("onnx", "openvino", "openvino-bf16")


class Translator:
    """Translates images one at a time, without state.

    Args:
        generator: a stored generator.
        backend: one of `BACKENDS`; results differ between them by a grey level or so.

    Raises:
        Sim2RealError: the backend is unknown.
        ds_driver.networks.backends.BackendError: the backend is not installed.
    """

    def __init__(self, generator: StoredGenerator, backend: str = "onnx") -> None:
        if backend not in BACKENDS:
            raise Sim2RealError(f"unknown backend {backend!r}: expected one of {', '.join(BACKENDS)}")
        self.generator = generator
        content = generator_to_onnx(generator)
        if backend == "onnx":
            self._runner = onnx_runner(content, "the generator")
        else:
            self._runner = openvino_runner(content, "the generator", bf16=backend == "openvino-bf16", batches=False)

    def prepared(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Cut out and resize what the generator sees of a camera image: (rows, columns, 3) uint8 RGB of its size."""
        return prepare(image, self.generator.window, self.generator.shape.size)

    def small(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Translate a prepared image, in the generator's size."""
        return self._runner.compute(image[None])[0][0].astype(np.uint8)

    def translate(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Translate a camera image.

        Args:
            image: (160, 320, 3) uint8 RGB.

        Returns:
            The generator's window of it, translated, as a whole image of (160, 320, 3): it is not to be cropped again.

        Raises:
            Sim2RealError: the image has another size than the camera of the generator's simulator.
        """
        if image.shape != (IMAGE_HEIGHT, IMAGE_WIDTH, 3):
            raise Sim2RealError(
                f"image of shape {image.shape}, expected ({IMAGE_HEIGHT}, {IMAGE_WIDTH}, 3): the generator translates "
                "camera images of simulators"
            )
        return resize(self.small(self.prepared(image)), (IMAGE_HEIGHT, IMAGE_WIDTH))
