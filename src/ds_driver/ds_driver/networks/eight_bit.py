"""Stores large layers of a network as 8-bit integers with a scale per row, which halves its weights file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save_file

from ds_driver.whole_files import whole_file

SCALE = ".scale"
"""End of the name of a tensor of scales."""
LARGEST = 127
"""Largest stored integer; the range is symmetric (Jacob et al. 2018, for weights)."""
SMALLEST_LAYER = 1_000_000
"""Fewest weights of a layer that is stored in 8 bits; chosen: smaller ones save less than 1 MB."""


def compress(path: Path, out: Path) -> list[str]:
    """Store the large layers of a weights file in 8 bits.

    Args:
        path: weights file in half precision.
        out: file to write; may be `path`.

    Returns:
        Names of the tensors that were compressed; those that already are in 8 bits stay as they are.
    """
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
        tensors: dict[str, NDArray[Any]] = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    matrices = {key: value for key, value in tensors.items() if value.ndim == 2 and value.dtype != np.int8}
    large = [key for key, value in matrices.items() if value.size >= SMALLEST_LAYER]
    for key in large:
        values = tensors[key].astype(np.float32)
        largest = np.abs(values).max(axis=1)
        scales = np.where(largest > 0, largest / LARGEST, 1.0).astype(np.float32)
        tensors[key] = np.rint(values / scales[:, None]).astype(np.int8)
        tensors[key + SCALE] = scales
    with whole_file(out) as partial:
        save_file(tensors, partial, metadata=metadata)
    return large


def expand(tensors: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    """Multiply stored integers by their rows' scales; other tensors stay as they are.

    Args:
        tensors: all tensors of a file, integers already as float32.
    """
    return {
        key: value * tensors[key + SCALE][:, None] if key + SCALE in tensors else value
        for key, value in tensors.items()
        if not key.endswith(SCALE)
    }
