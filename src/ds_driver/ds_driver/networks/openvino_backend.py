"""Runs networks with OpenVINO on the CPU, on one thread, alone or in batches with the same bits."""

from __future__ import annotations

import tempfile
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.backends import BackendError, Runner, last_line, shape_and_type
from ds_sim.installation import install_command

LARGEST_BATCH = 8
"""Images in one inference; chosen: Dave-2 gains 28 % from 1 to 4 and 3 % from 4 to 8 (benchmarks/inference.py)."""


def openvino_runner(
    content: bytes, where: str, *, kind: str = "onnx", bf16: bool = False, batches: bool = False
) -> Runner:
    """Run an ONNX, TensorFlow Lite or TorchScript file with OpenVINO; check a foreign ONNX file first.

    Args:
        content: content of the file.
        where: name of the file, for messages.
        kind: `onnx`, `tflite` or `torchscript`.
        bf16: compute in bfloat16 instead of single precision.
        batches: whether the network treats the images of a batch independently; with one input and output.

    Raises:
        BackendError: OpenVINO is not installed, cannot read the file, or the processor has no bfloat16.
    """
    try:
        import openvino
    except ImportError:
        raise BackendError(f"OpenVINO is not installed (60 MB): type {install_command('openvino')}") from None
    core = openvino.Core()
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
        raise BackendError(f"{where} cannot be loaded by OpenVINO ({last_line(error)}): is the file whole?") from None
    if len(compiled.inputs) != 1:
        raise BackendError(f"{where} has {len(compiled.inputs)} inputs: expected one, the image")
    request = compiled.create_infer_request()
    only_input = compiled.inputs[0]

    def compute(batch: NDArray[Any]) -> list[NDArray[np.float32]]:
        return _infer(request, batch)

    def compile_for(size: int) -> Any:
        resized = model.clone()  # shares the weights
        resized.reshape([size, *only_input.get_shape()[1:]])
        return core.compile_model(resized, "CPU", settings).create_infer_request()

    return Runner(
        _Batches(request, compile_for).compute if batches else compute,
        tuple(next(iter(sorted(o.get_names())), "") for o in compiled.outputs),
        tuple(d.get_length() if d.is_static else None for d in only_input.get_partial_shape())
        if only_input.get_partial_shape().rank.is_static
        else None,
        only_input.get_element_type().to_dtype().name,
        LARGEST_BATCH if batches else 1,
    )


def cpu_capabilities(core: Any) -> list[str]:
    """List what the processor can compute with, in OpenVINO's words: `FP32`, `BF16`, `INT8`, ..."""
    return list(core.get_property("CPU", "OPTIMIZATION_CAPABILITIES"))


class _Batches:
    """Runs a network on any number of images, each with the bits that it has alone.

    A graph compiled for one batch size gives these bits; a graph for any size gives others and is slower. So there is
    one graph for each power of two, compiled when first needed, and 7 images are run as 4, 2 and 1. Which kernels
    OpenVINO selects depends on the processor: each new graph is compared with the graph for one image, and batches are
    no longer used if a bit differs.

    Args:
        alone: request of the graph for one image.
        compile_for: makes the request for a batch size.
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
        file.write_bytes(content)
        return core.read_model(file)
    if kind == "torchscript":
        import openvino
        import torch

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return openvino.convert_model(torch.jit.load(BytesIO(content)).eval())
    return core.read_model(BytesIO(content))


def _infer(request: Any, batch: NDArray[Any]) -> list[NDArray[np.float32]]:
    try:
        found = request.infer([np.ascontiguousarray(batch)], share_inputs=True)
    except Exception as error:
        raise BackendError(f"the network rejects {shape_and_type(batch)}: {last_line(error)}") from None
    return [np.array(output, np.float32) for output in found.values()]
