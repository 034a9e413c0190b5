"""Collects the nodes and constants of an ONNX graph, without PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

OPSET = 17
"""ONNX opset; chosen: has all operators needed, and is old enough for every runtime in use."""
IR_VERSION = 8
"""Format of the file that belongs to the opset."""


class OnnxGraph:
    """Graph under construction; values are named in the order of their nodes."""

    def __init__(self) -> None:
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

    def file(self, name: str, given: tuple[str, int, Sequence[Any]], result: tuple[str, int, Sequence[Any]]) -> bytes:
        """Return the content of an ONNX file; the last node computes the result.

        Args:
            name: name of the graph.
            given: name, element type and shape of the input.
            result: the same of the output.
        """
        self._nodes[-1].output[0] = result[0]
        graph = helper.make_graph(
            self._nodes,
            name,
            [helper.make_tensor_value_info(*given)],
            [helper.make_tensor_value_info(*result)],
            self._constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        content: bytes = model.SerializeToString()
        return content
