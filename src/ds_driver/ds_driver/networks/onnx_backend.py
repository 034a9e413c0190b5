"""Runs ONNX files with ONNX Runtime on the CPU, on one thread."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.backends import BackendError, Runner, last_line, shape_and_type


def check_onnx(content: bytes, where: str) -> None:
    """Refuse an ONNX file that is damaged or has external data.

    Runtimes look for external data relative to the working directory, and the network's hash would not cover it.

    Raises:
        BackendError: not an ONNX graph, or one with external data.
    """
    import onnx
    from google.protobuf.message import DecodeError

    model = onnx.ModelProto()
    try:
        model.ParseFromString(content)
    except (DecodeError, RecursionError) as error:
        raise BackendError(
            f"{where} cannot be loaded ({last_line(error)}): is it a whole ONNX file, with its weights inside?"
        ) from None
    graphs = [model.graph, *(info.algorithm for info in model.training_info)]
    nodes = [node for function in model.functions for node in function.node]
    while graphs or nodes:
        tensors: list[Any] = []
        for graph in graphs:
            nodes += graph.node
            tensors += [*graph.initializer, *(t for s in graph.sparse_initializer for t in (s.values, s.indices))]
        graphs, attributes, nodes = [], [a for node in nodes for a in node.attribute], []
        for attribute in attributes:
            graphs += [attribute.g, *attribute.graphs] if attribute.HasField("g") or attribute.graphs else []
            sparse = [attribute.sparse_tensor, *attribute.sparse_tensors]
            tensors += [attribute.t, *attribute.tensors, *(t for s in sparse for t in (s.values, s.indices))]
        if any(t.external_data or t.data_location == onnx.TensorProto.EXTERNAL for t in tensors):
            raise BackendError(f"{where} keeps its weights in other files: save it with all of them inside")


def onnx_runner(content: bytes, where: str) -> Runner:
    """Run an ONNX graph with ONNX Runtime; check a foreign file with `check_onnx` first.

    Raises:
        BackendError: the file is damaged, or has more than one input.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # its messages come as exceptions, too
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its exceptions share no narrower base class
        raise BackendError(
            f"{where} cannot be loaded ({last_line(error)}): is it a whole ONNX file, with its weights inside?"
        ) from None
    inputs = session.get_inputs()
    if len(inputs) != 1:
        names = ", ".join(i.name for i in inputs)
        raise BackendError(f"{where} has {len(inputs)} inputs ({names}): expected one, the image")
    name = inputs[0].name
    kinds = {"tensor(float)": "float32", "tensor(uint8)": "uint8", "tensor(float16)": "float16"}

    def compute(batch: NDArray[Any]) -> list[NDArray[np.float32]]:
        try:
            found = session.run(None, {name: np.ascontiguousarray(batch)})
        except Exception as error:
            raise BackendError(f"the network rejects {shape_and_type(batch)}: {last_line(error)}") from None
        return [np.asarray(part, np.float32) for part in found]

    return Runner(
        compute,
        tuple(o.name for o in session.get_outputs()),
        tuple(size if isinstance(size, int) else None for size in inputs[0].shape),
        kinds.get(inputs[0].type, inputs[0].type),
    )
