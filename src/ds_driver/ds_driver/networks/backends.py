"""Runs networks with PyTorch, ONNX Runtime or OpenVINO, on one thread and in single precision.

A driver's name may end in `@torch`, `@onnx`, `@openvino`, or `@cuda` (PyTorch on a GPU): `dave2@openvino`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ds_driver.networks.pilot import DriverError

BACKENDS = ("auto", "torch", "onnx", "openvino")
"""auto: `network_driver.BUILT_IN_BACKEND` for built-in networks, the native backend for a network file."""
DEVICES = ("cpu", "cuda")

Compute = Callable[[NDArray[Any]], list[NDArray[np.float32]]]


class BackendError(DriverError):
    """The backend or device is unknown, not installed, or cannot run this network."""


@dataclass(frozen=True)
class Runner:
    """Loaded network.

    Attributes:
        compute: maps an input with a batch of one, or up to `largest_batch`, to all outputs.
        outputs: names of the outputs, if the file has any.
        shape: shape of the input, with None for a free size; None if the file does not state it.
        type: NumPy name of the input's data type; "" if the file does not state it.
        largest_batch: images in one input for which each result has the bits that it has alone.
    """

    compute: Compute
    outputs: tuple[str, ...] = ()
    shape: tuple[int | None, ...] | None = None
    type: str = ""
    largest_batch: int = 1


def split_backend(driver: str) -> tuple[str, str, str]:
    """Split a driver's name into the name without its suffix, the backend, and the device."""
    name, at, ending = driver.rpartition("@")
    if at and ending == "cuda":
        return name, "torch", "cuda"
    return (name, ending, "cpu") if at and ending in BACKENDS else (driver, "auto", "cpu")


def with_backend(driver: str, backend: str = "auto", device: str = "cpu") -> str:
    """Append the backend or the device to a driver's name.

    Raises:
        BackendError: the backend or the device is unknown, or they cannot be combined.
    """
    if backend not in BACKENDS:
        raise BackendError(f"unknown backend {backend!r}: expected one of {', '.join(BACKENDS)}")
    if device not in DEVICES:
        raise BackendError(f"unknown device {device!r}: expected one of {', '.join(DEVICES)}")
    if device == "cuda" and backend not in ("auto", "torch"):
        raise BackendError(f"backend {backend} runs on the CPU only: leave out --device cuda")
    if device == "cpu" and backend == "auto":
        return driver
    return f"{split_backend(driver)[0]}@{'cuda' if device == 'cuda' else backend}"


def torch_device(name: str) -> torch.device:
    """Return the PyTorch device of a name.

    Raises:
        BackendError: a GPU is requested and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise BackendError("PyTorch finds no usable GPU: leave out --device cuda, or install PyTorch for CUDA")
    return torch.device(name)


def torch_runner(network: Callable[[torch.Tensor], Any], device: torch.device) -> Runner:
    """Run a network with PyTorch.

    Args:
        network: maps one tensor to a tensor or a sequence of tensors; already on the device.
        device: device of the network.
    """
    torch.set_num_threads(1)

    @torch.inference_mode()
    def compute(batch: NDArray[Any]) -> list[NDArray[np.float32]]:
        try:
            found = network(torch.from_numpy(batch).to(device))
        except Exception as error:  # TorchScript raises whatever its program raises: IndexError, KeyError, ...
            raise BackendError(f"the network rejects {shape_and_type(batch)}: {last_line(error)}") from None
        parts: Sequence[Any] = found if isinstance(found, (tuple, list)) else [found]
        if not parts or not all(isinstance(part, torch.Tensor) for part in parts):
            raise BackendError(f"the network returns {type(found).__name__}: expected a tensor or a tuple of them")
        return [part.float().cpu().numpy() for part in parts]

    return Runner(compute)


def torchscript_runner(content: bytes, device: torch.device, where: str) -> Runner:
    """Run a TorchScript file with PyTorch.

    Args:
        content: content of the file.
        device: device to run on.
        where: name of the file, for messages.

    Raises:
        BackendError: the file is not TorchScript.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch still reads TorchScript, which it deprecates
        try:
            network = torch.jit.load(BytesIO(content), map_location=device).eval()
        except Exception as error:  # damaged archives make the reader raise arbitrary errors
            raise BackendError(
                f"{where} is not TorchScript ({last_line(error)}): save it with torch.jit.trace(network, image).save"
            ) from None
    return torch_runner(network, device)


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
    """Run an ONNX graph with ONNX Runtime.

    Raises:
        BackendError: the file is damaged, keeps its weights in other files, or has more than one input.
    """
    import onnxruntime

    check_onnx(content, where)
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


def last_line(error: BaseException) -> str:
    """Return the last line of an exception's message, at most 200 characters."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__)[:200]


def shape_and_type(batch: NDArray[Any]) -> str:
    """Describe an input, for messages."""
    return f"an input of shape {'x'.join(map(str, batch.shape))} and type {batch.dtype}"
