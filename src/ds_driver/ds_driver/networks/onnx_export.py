"""Exports the built-in networks to ONNX node by node, as PyTorch's exporter needs a further package."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

OPSET = 17
"""ONNX opset; chosen: has all operators needed, and is old enough for every runtime in use."""


def to_onnx(network: nn.Module) -> bytes:
    """Export a network of `ds_driver.networks.architectures` as the content of an ONNX file.

    The input is `image`, (1, 160, 320, 3) uint8 YUV from `ds_driver.networks.preprocessing.prepare`; the output is
    `steering`, (1, 1) float32.

    Raises:
        TypeError: the network has a layer that no built-in network has.
    """
    graph = _Graph()
    value = graph.node("Cast", ["image"], to=TensorProto.FLOAT)
    value = graph.node("Transpose", [value], perm=[0, 3, 1, 2])
    value = graph.node("Div", [value, graph.constant(np.float32(127.5))])
    value = graph.node("Sub", [value, graph.constant(np.float32(1.0))])
    layers = [layer for part in ("features", "steering") for layer in _flat(network.get_submodule(part))]
    for before, layer in pairwise([nn.Identity(), *layers]):
        value = graph.layer(layer, value, padding=before if isinstance(before, nn.ZeroPad2d) else None)
    graph.nodes[-1].output[0] = "steering"
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            type(network).__name__,
            [helper.make_tensor_value_info("image", TensorProto.UINT8, [1, IMAGE_HEIGHT, IMAGE_WIDTH, 3])],
            [helper.make_tensor_value_info("steering", TensorProto.FLOAT, [1, 1])],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=8,  # belongs to opset 17
    )
    onnx.checker.check_model(model)
    content: bytes = model.SerializeToString()
    return content


def _flat(module: nn.Module) -> list[nn.Module]:
    """List the layers in order, without containers and without layers that only training uses."""
    if isinstance(module, nn.Sequential):
        return [layer for part in module for layer in _flat(part)]
    return [] if isinstance(module, nn.Dropout) else [module]


class _Graph:
    """Collects the nodes and constants of a graph."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def node(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        name = f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, value: np.ndarray | np.float32) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def layer(self, layer: nn.Module, value: str, *, padding: nn.ZeroPad2d | None) -> str:
        """Add a layer with a value as its input; return the name of its output."""
        if isinstance(layer, (nn.Conv2d, nn.Linear)):
            assert layer.bias is not None
            inputs = [value, *(self.constant(p.detach().numpy()) for p in (layer.weight, layer.bias))]
            if isinstance(layer, nn.Linear):
                return self.node("Gemm", inputs, transB=1)
            rows, columns = (int(p) for p in layer.padding)
            left, right, top, bottom = padding.padding if padding else (columns, columns, rows, rows)
            return self.node("Conv", inputs, strides=list(layer.stride), pads=[top, left, bottom, right])
        if isinstance(layer, nn.ZeroPad2d):
            return value  # the next convolution does the padding
        if isinstance(layer, nn.MaxPool2d):
            return self.node("MaxPool", [value], kernel_shape=[layer.kernel_size] * 2, strides=[layer.stride] * 2)
        simple = {nn.ELU: "Elu", nn.ReLU: "Relu", nn.Flatten: "Flatten"}
        if type(layer) not in simple:
            raise TypeError(f"{type(layer).__name__} has no counterpart here: add it to onnx_export.py")
        return self.node(simple[type(layer)], [value])
