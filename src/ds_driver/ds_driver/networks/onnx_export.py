"""Exports the built-in networks to ONNX node by node, from their tables of layers, without PyTorch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto

from ds_driver.networks.architectures import Conv, Dense, Dropout, Layer, MaxPool
from ds_driver.networks.onnx_graph import OnnxGraph
from ds_driver.networks.weights import Weights
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH


def to_onnx(weights: Weights) -> bytes:
    """Export a built-in network as the content of an ONNX file.

    The input is `image`, (1, 160, 320, 3) uint8 YUV from `ds_driver.networks.preprocessing.prepare`; the output is
    `steering`, (1, 1) float32.
    """
    graph = OnnxGraph()
    value = graph.node("Cast", ["image"], to=TensorProto.FLOAT)
    value = graph.node("Transpose", [value], perm=[0, 3, 1, 2])
    value = graph.node("Div", [value, graph.constant(np.float32(127.5))])
    value = graph.node("Sub", [value, graph.constant(np.float32(1.0))])
    for name, layer in weights.architecture.layers():
        value = _layer(graph, layer, name, weights.tensors, value)
    return graph.file(
        weights.architecture.title,
        ("image", TensorProto.UINT8, [1, IMAGE_HEIGHT, IMAGE_WIDTH, 3]),
        ("steering", TensorProto.FLOAT, [1, 1]),
    )


def _layer(graph: OnnxGraph, layer: Layer, name: str, tensors: dict[str, NDArray[np.float32]], value: str) -> str:
    """Add a layer with a value as its input; return the name of its output."""
    if isinstance(layer, Dropout):
        return value
    if isinstance(layer, MaxPool):
        return graph.node("MaxPool", [value], kernel_shape=[layer.size] * 2, strides=[layer.size] * 2)
    if isinstance(layer, (Conv, Dense)):
        inputs = [value, *(graph.constant(tensors[f"{name}.{part}"]) for part in ("weight", "bias"))]
        if isinstance(layer, Dense):
            return graph.node("Gemm", inputs, transB=1)
        before, after = layer.padding
        return graph.node("Conv", inputs, strides=[layer.stride] * 2, pads=[before, before, after, after])
    return graph.node(layer.kind, [value])
