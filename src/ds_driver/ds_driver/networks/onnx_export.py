# SPDX-License-Identifier: Apache-2.0
"""Exports the built-in networks to ONNX node by node, from their tables of layers, without PyTorch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from ds_driver.networks.architectures import Conv, Dense, Dropout, Layer, MaxPool
from ds_driver.networks.weights import Weights
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

    def file(
        self, name: str, argument: tuple[str, int, Sequence[Any]], result: tuple[str, int, Sequence[Any]]
    ) -> bytes:
        """Return the content of an ONNX file; the last node computes the result.

        `argument` and `result` are name, element type and shape of the input and of the output.
        """
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
        value = _layer(graph, layer, name, value)
    return graph.file(
        weights.architecture.title,
        ("image", TensorProto.UINT8, [1, IMAGE_HEIGHT, IMAGE_WIDTH, 3]),
        ("steering", TensorProto.FLOAT, [1, 1]),
    )


def _layer(graph: OnnxGraph, layer: Layer, name: str, value: str) -> str:
    if isinstance(layer, Dropout):
        return value
    if isinstance(layer, MaxPool):
        return graph.node("MaxPool", [value], kernel_shape=[layer.size] * 2, strides=[layer.size] * 2)
    if isinstance(layer, Dense):
        return graph.node("Gemm", [value, *graph.parameters(name)], transB=1)
    if isinstance(layer, Conv):
        before, after = layer.padding
        pads = [before, before, after, after]
        return graph.node("Conv", [value, *graph.parameters(name)], strides=[layer.stride] * 2, pads=pads)
    return graph.node(layer.kind, [value])
