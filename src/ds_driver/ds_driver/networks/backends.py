"""Names the backends that run networks, on one thread: PyTorch, ONNX Runtime and OpenVINO.

A driver's name may end in `@torch`, `@onnx`, `@openvino`, `@openvino-bf16`, or `@cuda` (PyTorch on a GPU):
`dave2@openvino`. All compute in single precision except `openvino-bf16`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.pilot import DriverError

BACKENDS = ("auto", "torch", "onnx", "openvino", "openvino-bf16")
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


def last_line(error: BaseException) -> str:
    """Return the last line of an exception's message, at most 200 characters."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__)[:200]


def shape_and_type(batch: NDArray[Any]) -> str:
    """Describe an input, for messages."""
    return f"an input of shape {'x'.join(map(str, batch.shape))} and type {batch.dtype}"
