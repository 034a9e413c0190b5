# SPDX-License-Identifier: Apache-2.0
"""Loads network files of known formats, within a limit on memory."""

from __future__ import annotations

import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ds_base.bounded_yaml import BoundedYamlError, read_bounded
from ds_base.installation import ds_command
from ds_driver.networks.backends import BackendError, Runner, check_onnx, onnx_runner, openvino_runner
from ds_driver.networks.pilot import DriverError
from ds_driver.networks.quantisation import Samples, for_backend

NETWORK_MEMORY = 4 * 2**30
"""Bytes beyond what the process has already mapped; chosen: 40 times the largest shipped network."""
WEIGHTS_ALONE = (".pth", ".ckpt")
"""File suffixes of PyTorch's weights without their network; nothing here unpickles them."""
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
_BACKENDS_OF = {
    "onnx": ("onnx", "openvino", "openvino-bf16", "openvino-int8"),
    "torchscript": ("torch", "openvino", "openvino-bf16"),
    "tflite": ("openvino", "openvino-bf16"),
}
"""Format -> backends that can run it; the first one is `auto`."""
LARGEST_FILE = 2**29
"""Bytes of a network file; chosen: five times the largest shipped network."""


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


def refuse_weights_alone(file: Path) -> None:
    """Refuse a file of PyTorch's weights, which only its own program can load.

    Raises:
        DriverError: it is one; the sentence says how to export the network.
    """
    if file.suffix.lower() in WEIGHTS_ALONE:
        raise DriverError(
            f"{file} holds weights alone: in the program that defines the network, load them and export it with "
            f'torch.onnx.export(network.eval(), (torch.zeros(1, 3, ROWS, COLUMNS),), "{file.stem}.onnx", '
            f"dynamo=False), then `{ds_command('check', f'{file.stem}.onnx')}`"
        )


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
    if kind == "onnx":
        check_onnx(content, file.name)
    if chosen.startswith("openvino"):
        return openvino_runner(for_backend(chosen, content, file.name, samples), file.name, chosen, kind=kind)
    if chosen == "onnx":
        return onnx_runner(content, file.name)
    from ds_driver.networks.torch_networks import torch_device, torchscript_runner

    return torchscript_runner(content, torch_device(device), file.name)
