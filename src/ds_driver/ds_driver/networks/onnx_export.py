"""Exports the built-in networks to ONNX node by node, from their tables of layers, without PyTorch."""

from __future__ import annotations

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


def to_onnx(weights: Weights) -> bytes:
    """Export a built-in network as the content of an ONNX file.

    The input is `image`, (1, 160, 320, 3) uint8 YUV from `ds_driver.networks.preprocessing.prepare`; the output is
    `steering`, (1, 1) float32.
    """
    graph = _Graph()
    value = graph.node("Cast", ["image"], to=TensorProto.FLOAT)
    value = graph.node("Transpose", [value], perm=[0, 3, 1, 2])
    value = graph.node("Div", [value, graph.constant(np.float32(127.5))])
    value = graph.node("Sub", [value, graph.constant(np.float32(1.0))])
    for name, layer in weights.architecture.layers():
        value = graph.layer(layer, name, weights.tensors, value)
    graph.nodes[-1].output[0] = "steering"
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            weights.architecture.title,
            [helper.make_tensor_value_info("image", TensorProto.UINT8, [1, IMAGE_HEIGHT, IMAGE_WIDTH, 3])],
            [helper.make_tensor_value_info("steering", TensorProto.FLOAT, [1, 1])],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=8,  # belongs to opset 17
    )
    content: bytes = model.SerializeToString()
    return content


class _Graph:
    """Collects the nodes and constants of a graph."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def node(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        name = f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, value: NDArray[np.float32] | np.float32) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def layer(self, layer: Layer, name: str, tensors: dict[str, NDArray[np.float32]], value: str) -> str:
        """Add a layer with a value as its input; return the name of its output."""
        if isinstance(layer, Dropout):
            return value
        if isinstance(layer, MaxPool):
            return self.node("MaxPool", [value], kernel_shape=[layer.size] * 2, strides=[layer.size] * 2)
        if isinstance(layer, (Conv, Dense)):
            inputs = [value, *(self.constant(tensors[f"{name}.{part}"]) for part in ("weight", "bias"))]
            if isinstance(layer, Dense):
                return self.node("Gemm", inputs, transB=1)
            before, after = layer.padding
            return self.node("Conv", inputs, strides=[layer.stride] * 2, pads=[before, before, after, after])
        return self.node(layer.kind, [value])
