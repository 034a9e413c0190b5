# SPDX-License-Identifier: Apache-2.0
"""Runs networks on one thread, in single precision unless asked for bfloat16: ONNX Runtime, OpenVINO and PyTorch."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_base.folder_files import write_whole
from ds_base.installation import install_command, processor_flags
from ds_driver.networks.pilot import DriverError

BACKENDS = ("auto", "torch", "onnx", "openvino", "openvino-bf16")
"""auto: `default_backend` for built-in networks and ONNX files, the native backend for other network files."""
DEVICES = ("cpu", "cuda")
LARGEST_BATCH = 8
"""Images in one inference; chosen: Dave-2 gains 28% from 1 to 4 and 3% from 4 to 8 (benchmarks/inference.py)."""


class BackendError(DriverError):
    """The backend or device is unknown, not installed, or cannot run this network."""


@dataclass(frozen=True)
class NetworkInput:
    """Input of a network file; fields that the file does not state are empty."""

    name: str = ""
    shape: tuple[int | None, ...] | None = None  # with None for a free size
    type: str = ""  # NumPy's name


@dataclass(frozen=True)
class Runner:
    """Loaded network; `compute` maps its inputs, in their order, to all outputs, as far as the file states them."""

    compute: Callable[..., list[NDArray[np.float32]]]
    outputs: tuple[str, ...] = ()  # names
    inputs: tuple[NetworkInput, ...] = ()
    largest_batch: int = 1  # images in one input for which each result has the bits that it has alone


def default_backend() -> str:
    """Back end of `auto`: OpenVINO in single precision where it is installed (docs/speed.md), else ONNX Runtime."""
    return "openvino" if find_spec("openvino") else "onnx"


def last_line(error: BaseException) -> str:
    """Return the last line of an exception's message, at most 200 characters."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__)[:200]


def shape_and_type(*inputs: NDArray[Any]) -> str:
    """Describe inputs, for messages."""
    shown = " and ".join(f"of shape {'x'.join(map(str, one.shape))} and type {one.dtype}" for one in inputs)
    return f"{'an input' if len(inputs) == 1 else 'inputs'} {shown}"


def check_onnx(content: bytes, where: str) -> None:
    """Refuse, by a BackendError, an ONNX file that is damaged or has external data.

    Runtimes look for that relative to the working directory, and the network's hash would not cover it.
    """
    import onnx
    from google.protobuf.message import DecodeError, Message

    model = onnx.ModelProto()
    try:
        model.ParseFromString(content)
    except (DecodeError, RecursionError) as error:
        raise BackendError(
            f"{where} cannot be loaded ({last_line(error)}): is it a whole ONNX file, with its weights inside?"
        ) from None
    messages: list[Any] = [model]
    while messages:
        message = messages.pop()
        if isinstance(message, onnx.TensorProto):
            if message.external_data or message.data_location == onnx.TensorProto.EXTERNAL:
                raise BackendError(f"{where} keeps its weights in other files: save it with all of them inside")
            continue
        for field, value in message.ListFields():
            if field.message_type is not None:
                messages += [value] if isinstance(value, Message) else value


def onnx_runner(content: bytes, where: str) -> Runner:
    """Run an ONNX graph with ONNX Runtime, a foreign one after `check_onnx`; a BackendError if it cannot be loaded."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # its messages come as exceptions, too
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its exceptions share no narrower base class
        raise BackendError(
            f"{where} cannot be loaded by ONNX Runtime ({last_line(error)}): export it again, with its weights inside, "
            "an older opset if it is too new, and no operators of its own"
        ) from None
    inputs = session.get_inputs()
    kinds = {"tensor(float)": "float32", "tensor(uint8)": "uint8", "tensor(float16)": "float16"}
    described = tuple(
        NetworkInput(
            one.name, tuple(n if isinstance(n, int) else None for n in one.shape), kinds.get(one.type, one.type)
        )
        for one in inputs
    )

    def compute(*arrays: NDArray[Any]) -> list[NDArray[np.float32]]:
        try:
            feed = {one.name: np.ascontiguousarray(array) for one, array in zip(inputs, arrays, strict=True)}
            outputs = session.run(None, feed)
        except Exception as error:
            raise BackendError(f"the network rejects {shape_and_type(*arrays)}: {last_line(error)}") from None
        return [np.asarray(part, np.float32) for part in outputs]

    return Runner(compute, tuple(one.name for one in session.get_outputs()), described)


def openvino_runner(
    content: bytes, where: str, backend: str = "openvino", *, kind: str = "onnx", batches: bool = False
) -> Runner:
    """Run an ONNX, TensorFlow Lite or TorchScript file with `openvino` or `openvino-bf16`; check foreign ONNX first.

    With `batches`, the network has one input and one output, and treats the images of a batch independently. Without
    OpenVINO, the processor's bfloat16, or a file that it reads there is a BackendError.
    """
    try:
        import openvino
    except ImportError:
        raise BackendError(f"OpenVINO is not installed (60 MB): type {install_command('openvino')}") from None
    core = openvino.Core()
    bf16 = backend == "openvino-bf16"
    if bf16 and "BF16" not in cpu_capabilities(core):
        raise BackendError("this processor has no bfloat16 (AVX512_BF16 or AMX): use the backend openvino")
    settings = {
        "INFERENCE_NUM_THREADS": 1,
        "NUM_STREAMS": 1,
        # The default is bfloat16 on processors that support it, which changes the results.
        "INFERENCE_PRECISION_HINT": "bf16" if bf16 else "f32",
        # With pinning, the drivers of several workers would share one core.
        "ENABLE_CPU_PINNING": False,
    }
    try:
        # OpenVINO reads TensorFlow Lite from files only, and may need the file until the model is compiled.
        with tempfile.TemporaryDirectory() as folder:
            model = _read(core, content, kind, Path(folder))
            compiled = core.compile_model(model, "CPU", settings)
    except Exception as error:  # its exceptions share no narrower base class
        way = "convert the model that it was made from to ONNX" if kind == "tflite" else "take another backend"
        raise BackendError(
            f"{where} cannot be run by OpenVINO ({last_line(error)}): {way}, or copy the file again if it is cut off"
        ) from None

    def compile_for(size: int) -> Any:
        resized = model.clone()  # shares the weights
        resized.reshape([size, *compiled.inputs[0].get_shape()[1:]])
        return core.compile_model(resized, "CPU", settings).create_infer_request()

    request = compiled.create_infer_request()
    compute = _Batches(request, compile_for).compute if batches else partial(_infer, request)
    inputs = tuple(map(_input_of, compiled.inputs))
    return Runner(compute, tuple(map(_name_of, compiled.outputs)), inputs, LARGEST_BATCH if batches else 1)


def _name_of(port: Any) -> str:
    return min(port.get_names(), default="")


def _input_of(port: Any) -> NetworkInput:
    sizes = port.get_partial_shape()
    shape = tuple(d.get_length() if d.is_static else None for d in sizes) if sizes.rank.is_static else None
    return NetworkInput(_name_of(port), shape, port.get_element_type().to_dtype().name)


def graph_runner(content: bytes, where: str, backend: str) -> Runner:
    """Run an ONNX graph of this project with a backend other than `torch`, in batches where their bits allow it."""
    chosen = default_backend() if backend == "auto" else backend
    return onnx_runner(content, where) if chosen == "onnx" else openvino_runner(content, where, chosen, batches=True)


def cpu_capabilities(core: Any) -> list[str]:
    """List what the processor can compute with, in OpenVINO's words: `FP32`, `BF16`, `INT8`, ..."""
    return list(core.get_property("CPU", "OPTIMIZATION_CAPABILITIES"))


def has_bfloat16() -> bool:
    """Whether this processor computes in bfloat16, as Linux lists it; without OpenVINO."""
    return not processor_flags().isdisjoint(("avx512_bf16", "amx_bf16"))


class _Batches:
    """Runs a network on any number of images, each with the bits that it has alone.

    A graph for batches of any size gives other bits and is slower. So there is one for each power of two, compiled when
    first needed: 7 images are run as 4, 2 and 1. As OpenVINO's kernels depend on the processor, each new graph is
    compared with that for one image, and batches are no longer used if a bit differs.
    """

    def __init__(self, alone: Any, compile_for: Any) -> None:
        self._requests = {1: alone}
        self._compile_for = compile_for
        self._largest = LARGEST_BATCH

    def compute(self, batch: NDArray[Any]) -> list[NDArray[np.float32]]:
        """Run any number of images, at least one."""
        results, start = [], 0
        while start < len(batch):
            size = min(1 << ((len(batch) - start).bit_length() - 1), self._largest)
            request = self._request(size, batch.shape[1:])
            if request is None:
                self._largest = 1
                continue
            results.append(_infer(request, batch[start : start + size])[0])
            start += size
        return [np.concatenate(results)]

    def _request(self, size: int, shape: tuple[int, ...]) -> Any:
        """Return the request for a batch size, or None if its bits differ from those of single images."""
        if size not in self._requests:
            request = self._compile_for(size)
            noise = np.random.default_rng(size).integers(0, 256, (size, *shape), dtype=np.uint8)
            alone = [_infer(self._requests[1], noise[i : i + 1])[0] for i in range(size)]
            if not np.array_equal(_infer(request, noise)[0], np.concatenate(alone), equal_nan=True):
                return None
            self._requests[size] = request
        return self._requests[size]


def _read(core: Any, content: bytes, kind: str, folder: Path) -> Any:
    if kind == "tflite":
        file = folder / "network.tflite"
        write_whole(file, content)
        return core.read_model(file)
    if kind == "torchscript":
        import openvino
        import torch

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return openvino.convert_model(torch.jit.load(BytesIO(content)).eval())
    return core.read_model(BytesIO(content))


def _infer(request: Any, *inputs: NDArray[Any]) -> list[NDArray[np.float32]]:
    try:
        outputs = request.infer([np.ascontiguousarray(one) for one in inputs], share_inputs=True)
    except Exception as error:
        raise BackendError(f"the network rejects {shape_and_type(*inputs)}: {last_line(error)}") from None
    return [np.array(output, np.float32) for output in outputs.values()]
