# SPDX-License-Identifier: Apache-2.0
"""Translates camera images with a generator's ONNX graph, in training and in driving alike: the same bits in both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

from ds_driver.networks.backends import graph_runner
from ds_driver.networks.onnx_export import OnnxGraph
from ds_driver.sim2real.generator import EPSILON, Sim2RealError, StoredGenerator, generator_input, resize
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

BACKENDS = ("onnx", "openvino", "openvino-bf16", "torch")


def generator_to_onnx(generator: StoredGenerator) -> bytes:
    """Export as ONNX: `image`, (1, rows, columns, 3) uint8 RGB from `generator_input`, to `translated`, the same."""
    graph = _Graph(generator.tensors)
    shape = generator.shape
    value = graph.convolution(graph.scaled("image"), "layers.1", reflect=3)
    value = graph.relu(graph.normalised(value, shape.filters))
    for layer, channels in ((4, 2), (7, 4)):
        value = graph.convolution(value, f"layers.{layer}", strides=[2, 2], pads=[1, 1, 1, 1])
        value = graph.relu(graph.normalised(value, channels * shape.filters))
    for block in range(10, 10 + shape.blocks):
        inner = graph.convolution(value, f"layers.{block}.body.1", reflect=1)
        inner = graph.relu(graph.normalised(inner, 4 * shape.filters))
        inner = graph.convolution(inner, f"layers.{block}.body.5", reflect=1)
        value = graph.node("Add", [value, graph.normalised(inner, 4 * shape.filters)])
    up = 10 + shape.blocks
    for layer, channels in ((up, 2), (up + 3, 1)):
        weights = graph.parameters(f"layers.{layer}")
        value = graph.node("ConvTranspose", [value, *weights], strides=[2, 2], pads=[1, 1, 1, 1], output_padding=[1, 1])
        value = graph.relu(graph.normalised(value, channels * shape.filters))
    value = graph.node("Tanh", [graph.convolution_by_squares(value, f"layers.{up + 7}", reflect=3)])
    one, half, black, white = (graph.constant(np.float32(number)) for number in (1.0, 127.5, 0.0, 255.0))
    value = graph.node("Mul", [graph.node("Add", [value, one]), half])
    value = graph.node("Clip", [graph.node("Round", [value]), black, white])
    graph.node("Cast", [graph.node("Transpose", [value], perm=[0, 2, 3, 1])], to=TensorProto.UINT8)
    dimensions = [1, shape.rows, shape.columns, 3]
    return graph.file(
        f"sim2real {generator.simulator}"[:100],
        ("image", TensorProto.UINT8, dimensions),
        ("translated", TensorProto.UINT8, dimensions),
    )


class _Graph(OnnxGraph):
    """Graph with the layers of a generator."""

    def convolution(self, value: str, layer: str, *, reflect: int = 0, **attributes: Any) -> str:
        return self.node("Conv", [self._padded(value, reflect), *self.parameters(layer)], **attributes)

    def convolution_by_squares(self, value: str, layer: str, *, reflect: int) -> str:
        """Convolve with few outputs: four pixels at once, by weights shifted inside a larger kernel; the same bits.

        Processors compute 16 outputs at a time, of which an image would use 3.
        """
        weights, bias = (self._tensors[f"{layer}.{part}"] for part in ("weight", "bias"))
        outputs, inputs, rows, columns = weights.shape
        shifted = np.zeros((2, 2, outputs, inputs, rows + 1, columns + 1), np.float32)
        for row, column in np.ndindex(2, 2):
            shifted[row, column, :, :, row : row + rows, column : column + columns] = weights
        parameters = [self.constant(shifted.reshape(4 * outputs, *shifted.shape[3:])), self.constant(np.tile(bias, 4))]
        value = self.node("Conv", [self._padded(value, reflect), *parameters], strides=[2, 2])
        return self.node("DepthToSpace", [value], blocksize=2)

    def _padded(self, value: str, reflect: int) -> str:
        pads = np.array([0, 0, reflect, reflect] * 2, np.int64)
        return self.node("Pad", [value, self.constant(pads)], mode="reflect") if reflect else value

    def normalised(self, value: str, channels: int) -> str:
        scale, shift = self.constant(np.ones(channels, np.float32)), self.constant(np.zeros(channels, np.float32))
        return self.node("InstanceNormalization", [value, scale, shift], epsilon=EPSILON)

    def relu(self, value: str) -> str:
        return self.node("Relu", [value])


class Translator:
    """Translates images: with the same bits alone and in any batch, and a grey level or so apart on other `BACKENDS`.

    Raises:
        Sim2RealError: the backend is unknown.
        ds_driver.networks.backends.BackendError: the backend is not installed.
    """

    def __init__(self, generator: StoredGenerator, backend: str = "onnx", device: str = "cpu") -> None:
        if backend not in BACKENDS:
            raise Sim2RealError(f"unknown backend {backend!r}: expected one of {', '.join(BACKENDS)}")
        self.generator = generator
        self.backend = backend
        if backend == "torch":
            # PyTorch takes 2 s and 200 MB to import.
            from ds_driver.sim2real.networks import generator_runner

            self._runner = generator_runner(generator, device)
        else:
            self._runner = graph_runner(generator_to_onnx(generator), "the generator", backend)

    def translate(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Translate a camera image, (160, 320, 3) uint8 RGB, to one of that shape that is not to be cropped again.

        Raises:
            Sim2RealError: the image has another size than the camera of the generator's simulator.
        """
        return self.translate_all([image])[0]

    def translate_all(self, images: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
        """Translate camera images, as many at once as the backend takes; see `translate`."""
        for image in images:
            if image.shape != (IMAGE_HEIGHT, IMAGE_WIDTH, 3):
                raise Sim2RealError(
                    f"image of shape {image.shape}, expected ({IMAGE_HEIGHT}, {IMAGE_WIDTH}, 3): the generator "
                    "translates camera images of simulators"
                )
        window, shape, size = self.generator.window, self.generator.shape.size, self._runner.largest_batch
        prepared = [generator_input(image, window, shape) for image in images]
        parts = (np.stack(prepared[begin : begin + size]) for begin in range(0, len(prepared), size))
        translated = (image for part in parts for image in self._runner.compute(part)[0].astype(np.uint8))
        return [resize(image, (IMAGE_HEIGHT, IMAGE_WIDTH)) for image in translated]
