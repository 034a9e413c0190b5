# SPDX-License-Identifier: Apache-2.0
"""Loads network files of known formats, within a limit on memory."""

from __future__ import annotations

import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ds_base.bounded_yaml import BoundedYamlError, read_bounded
from ds_driver.networks.backends import BackendError, Runner, check_onnx, onnx_runner, openvino_runner
from ds_driver.networks.foreign_file import LARGEST_FILE, foreign
from ds_driver.networks.pilot import DriverError
from ds_driver.networks.quantisation import Samples, for_backend

NETWORK_MEMORY = 4 * 2**30
"""Bytes beyond what the process has already mapped; chosen: 40 times the largest shipped network."""
_lock = threading.Lock()
_inside = 0
_before = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
KINDS = {
    ".onnx": "onnx",
    ".pt": "torchscript",
    ".ts": "torchscript",
    ".torchscript": "torchscript",
    ".tflite": "tflite",
}
"""File suffix -> format."""
_FORMATS = {"torchscript": "TorchScript", "tflite": "TensorFlow Lite"}
_BACKENDS_OF = {
    "onnx": ("onnx", "openvino", "openvino-bf16", "openvino-int8"),
    "torchscript": ("torch", "openvino", "openvino-bf16"),
    "tflite": ("openvino", "openvino-bf16"),
}
"""Format -> backends that can run it; the first one is `auto`."""


@contextmanager
def limited_memory() -> Iterator[None]:
    """Make allocations fail beyond the present address space plus `NETWORK_MEMORY`.

    A graph of three nodes can ask for terabytes, and the runtimes set no limit. The limit applies to the whole process,
    other threads included; nested and concurrent uses keep the first limit.
    """
    global _inside, _before
    with _lock:
        _inside += 1
        if _inside == 1:
            _before = resource.getrlimit(resource.RLIMIT_AS)
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            wanted = pages * resource.getpagesize() + NETWORK_MEMORY
            limits = [limit for limit in (*_before, wanted) if limit != resource.RLIM_INFINITY]
            resource.setrlimit(resource.RLIMIT_AS, (min(limits), _before[1]))
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                resource.setrlimit(resource.RLIMIT_AS, _before)


def runner_of(file: Path, backend: str = "auto", device: str = "cpu", samples: Samples = lambda: []) -> Runner:
    """Load a network file, whatever its description says; see `DescribedNetworkPilot`."""
    kind = KINDS[file.suffix.lower()]
    possible = _BACKENDS_OF[kind]
    chosen = possible[0] if backend == "auto" else backend
    if chosen not in possible:
        expected = ", ".join(possible[:-1]) + f" or {possible[-1]}"
        raise BackendError(f"backend {chosen} cannot run {file.name}: expected {expected}")
    try:
        content = read_bounded(file, LARGEST_FILE)
    except (BoundedYamlError, OSError) as error:
        raise DriverError(f"{file} cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if problem := foreign(content, file):
        raise DriverError(problem)
    really = "tflite" if content[4:8] == b"TFL3" else "torchscript" if content.startswith(b"PK") else kind
    if really != kind:
        suffix = next(suffix for suffix, one in KINDS.items() if one == really)
        raise DriverError(f"{file} is a {_FORMATS[really]} file: rename it to {file.with_suffix(suffix).name}")
    if kind == "onnx":
        check_onnx(content, file.name)
    if chosen.startswith("openvino"):
        return openvino_runner(for_backend(chosen, content, file.name, samples), file.name, chosen, kind=kind)
    if chosen == "onnx":
        return onnx_runner(content, file.name)
    from ds_driver.networks.torch_networks import torch_device, torchscript_runner

    return torchscript_runner(content, torch_device(device), file.name)
