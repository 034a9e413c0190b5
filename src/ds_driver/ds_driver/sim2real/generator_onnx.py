"""Exports a generator to ONNX node by node, without PyTorch; driving and translating run this graph."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

from ds_driver.networks.onnx_export import OnnxGraph
from ds_driver.sim2real.generator_file import StoredGenerator
from ds_driver.sim2real.shape import EPSILON


def generator_to_onnx(generator: StoredGenerator) -> bytes:
    """Export a generator as the content of an ONNX file.

    The input is `image`, (1, rows, columns, 3) uint8 RGB from `ds_driver.sim2real.window.prepare`; the output is
    `translated`, of the same shape and type.
    """
    graph = _Graph(generator.tensors)
    shape = generator.shape
    value = graph.node("Cast", ["image"], to=TensorProto.FLOAT)
    value = graph.node("Transpose", [value], perm=[0, 3, 1, 2])
    value = graph.node("Sub", [graph.node("Div", [value, graph.number(127.5)]), graph.number(1.0)])
    value = graph.convolution(value, "layers.1", reflect=3)
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
    value = graph.node("Tanh", [graph.convolution(value, f"layers.{up + 7}", reflect=3)])
    value = graph.node("Mul", [graph.node("Add", [value, graph.number(1.0)]), graph.number(127.5)])
    value = graph.node("Clip", [graph.node("Round", [value]), graph.number(0.0), graph.number(255.0)])
    graph.node("Cast", [graph.node("Transpose", [value], perm=[0, 2, 3, 1])], to=TensorProto.UINT8)
    dimensions = [1, shape.rows, shape.columns, 3]
    return graph.file(
        f"sim2real {generator.simulator}"[:100],
        ("image", TensorProto.UINT8, dimensions),
        ("translated", TensorProto.UINT8, dimensions),
    )


class _Graph(OnnxGraph):
    """Graph of layers with the names of a generator's tensors."""

    def __init__(self, tensors: dict[str, NDArray[np.float32]]) -> None:
        super().__init__()
        self._tensors = tensors

    def number(self, value: float) -> str:
        return self.constant(np.array(value, np.float32))

    def parameters(self, layer: str) -> list[str]:
        return [self.constant(self._tensors[f"{layer}.{part}"]) for part in ("weight", "bias")]

    def convolution(self, value: str, layer: str, *, reflect: int = 0, **attributes: Any) -> str:
        if reflect:
            pads = np.array([0, 0, reflect, reflect] * 2, np.int64)
            value = self.node("Pad", [value, self.constant(pads)], mode="reflect")
        return self.node("Conv", [value, *self.parameters(layer)], **attributes)

    def normalised(self, value: str, channels: int) -> str:
        scale, shift = self.constant(np.ones(channels, np.float32)), self.constant(np.zeros(channels, np.float32))
        return self.node("InstanceNormalization", [value, scale, shift], epsilon=EPSILON)

    def relu(self, value: str) -> str:
        return self.node("Relu", [value])
