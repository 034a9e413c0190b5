# SPDX-License-Identifier: Apache-2.0
"""Loads network files of known formats."""

from __future__ import annotations

from pathlib import Path

from ds_base.bounded_file import FileError, read_regular
from ds_base.words import listed
from ds_driver.networks.backends import (
    BackendError,
    Runner,
    check_onnx,
    default_backend,
    onnx_runner,
    openvino_runner,
)
from ds_driver.networks.foreign_file import LARGEST_FILE, foreign
from ds_driver.networks.pilot import DriverError

NETWORK_MEMORY = 4 * 2**30
"""Bytes that a network may map beyond what the process has; chosen: 40 times the largest shipped one. A graph of three
nodes can ask for terabytes, and the runtimes set no limit."""
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
    "onnx": ("onnx", "openvino", "openvino-bf16"),
    "torchscript": ("torch", "openvino", "openvino-bf16"),
    "tflite": ("openvino", "openvino-bf16"),
}
"""Format -> backends that can run it; `auto` is the first one, for ONNX `default_backend` where it can run the file."""


def backends_for(file: Path, backend: str = "auto") -> tuple[str, ...]:
    """Back ends to try for a network file, in order.

    Raises:
        BackendError: this one cannot run such a file.
    """
    kind = KINDS[file.suffix.lower()]
    possible = _BACKENDS_OF[kind]
    if backend == "auto":
        # ONNX Runtime knows every operator of ONNX, OpenVINO most of them.
        return tuple(dict.fromkeys((default_backend(), "onnx"))) if kind == "onnx" else possible[:1]
    if backend not in possible:
        raise BackendError(f"backend {backend} cannot run {file.name}: expected {listed(possible, 'or')}")
    return (backend,)


def runner_of(file: Path, chosen: str, device: str = "cpu") -> Runner:
    """Load a network file with one of `backends_for` it, whatever its description says; see `DescribedNetworkPilot`."""
    kind = KINDS[file.suffix.lower()]
    try:
        content = read_regular(file, LARGEST_FILE)
    except (FileError, OSError) as error:
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
        return openvino_runner(content, file.name, chosen, kind=kind)
    if chosen == "onnx":
        return onnx_runner(content, file.name)
    from ds_driver.networks.torch_networks import torch_device, torchscript_runner

    return torchscript_runner(content, torch_device(device), file.name)
