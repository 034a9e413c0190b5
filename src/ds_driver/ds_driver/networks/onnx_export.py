# SPDX-License-Identifier: Apache-2.0
"""Exports the built-in networks and generators to ONNX node by node, without PyTorch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from ds_driver.networks.architectures import Conv, Dense, Dropout, MaxPool
from ds_driver.networks.weights import Weights
from ds_driver.sim2real.generator import EPSILON, StoredGenerator
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

OPSET = 17
"""ONNX opset; chosen: has all operators needed, and is old enough for every runtime in use."""
IR_VERSION = 8
"""Format of the file that belongs to the opset."""


class OnnxGraph:
    """Graph under construction, of layers whose `tensors` are named LAYER.weight and LAYER.bias."""

    def __init__(self, tensors: Mapping[str, NDArray[np.float32]]) -> None:
        self._tensors = tensors
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []

    def node(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        """Add an operator; return the name of its output."""
        name = f"value_{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, value: NDArray[Any] | np.generic) -> str:
        """Add a constant; return its name."""
        name = f"constant_{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def parameters(self, layer: str) -> list[str]:
        """Add the weights and the biases of a layer; return their names."""
        return [self.constant(self._tensors[f"{layer}.{part}"]) for part in ("weight", "bias")]

    def scaled(self, image: str) -> str:
        """Convert (n, rows, columns, 3) uint8 to (n, 3, rows, columns) in -1 to 1; OpenVINO needs no transposition."""
        value = self.node("Cast", [image], to=TensorProto.FLOAT)
        value = self.node("Div", [value, self.constant(np.float32(127.5))])
        value = self.node("Sub", [value, self.constant(np.float32(1.0))])
        return self.node("Transpose", [value], perm=[0, 3, 1, 2])

    def convolution(self, value: str, layer: str, *, reflect: int = 0, **attributes: Any) -> str:
        """Add a convolution, of a value that is mirrored by so many pixels at its sides."""
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
        """Add an instance normalisation."""
        scale, shift = self.constant(np.ones(channels, np.float32)), self.constant(np.zeros(channels, np.float32))
        return self.node("InstanceNormalization", [value, scale, shift], epsilon=EPSILON)

    def relu(self, value: str) -> str:
        """Add a rectifier."""
        return self.node("Relu", [value])

    def file(
        self, name: str, argument: tuple[str, int, Sequence[Any]], result: tuple[str, int, Sequence[Any]]
    ) -> bytes:
        """Make an ONNX file, given name, element type and shape of the input, and of the result of the last node."""
        self._nodes[-1].output[0] = result[0]
        graph = helper.make_graph(
            self._nodes,
            name,
            [helper.make_tensor_value_info(*argument)],
            [helper.make_tensor_value_info(*result)],
            self._constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        content: bytes = model.SerializeToString()
        return content


def to_onnx(weights: Weights) -> bytes:
    """Export a built-in network as the content of an ONNX file.

    The input is `image`, (1, 160, 320, 3) uint8 YUV from `ds_driver.networks.images.prepare`; the output is
    `steering`, (1, 1) float32.
    """
    graph = OnnxGraph(weights.tensors)
    value = graph.scaled("image")
    for name, layer in weights.architecture.layers():
        if isinstance(layer, MaxPool):
            value = graph.node("MaxPool", [value], kernel_shape=[layer.size] * 2, strides=[layer.size] * 2)
        elif isinstance(layer, Dense):
            value = graph.node("Gemm", [value, *graph.parameters(name)], transB=1)
        elif isinstance(layer, Conv):
            pads = [pad for pad in layer.padding for _ in range(2)]
            value = graph.convolution(value, name, strides=[layer.stride] * 2, pads=pads)
        elif not isinstance(layer, Dropout):
            value = graph.node(layer.kind, [value])
    return graph.file(
        weights.architecture.title,
        ("image", TensorProto.UINT8, [1, IMAGE_HEIGHT, IMAGE_WIDTH, 3]),
        ("steering", TensorProto.FLOAT, [1, 1]),
    )


def generator_to_onnx(generator: StoredGenerator) -> bytes:
    """Export as ONNX: `image`, (1, rows, columns, 3) uint8 RGB from `generator_input`, to `translated`, the same."""
    graph = OnnxGraph(generator.tensors)
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
