# SPDX-License-Identifier: Apache-2.0
"""Stored generators: their size, what they see of an image, and their files; without PyTorch."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import load, save

from ds_base.bounded_file import load_json, read_regular
from ds_base.errors import InputError
from ds_base.folder_files import write_whole

EPSILON = 1e-5
"""Added to the variance of an instance normalisation (PyTorch's default)."""
MIN_SIDE = 8
"""Fewest rows and columns of a window, px; chosen: less than a lane line is wide near the car."""
KIND = "sim2real generator 1"
"""Key of the metadata, and format of the file."""
LARGEST_FILE = 2**28
"""Bytes of a generator's file; chosen: ten times the paper's size in half precision."""
MOST_FILTERS, MOST_BLOCKS, MOST_PIXELS = 256, 32, 2**22


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorShape:
    """Size: channels of the first layer (paper: 64), residual blocks (paper: 9), and the image's, in multiples of 4."""

    filters: int
    blocks: int
    rows: int
    columns: int

    @property
    def size(self) -> tuple[int, int]:
        """Return rows and columns."""
        return self.rows, self.columns


class Sim2RealError(InputError):
    """Photographs, generators or settings that cannot be used."""


@dataclass(frozen=True, slots=True)
class Window:
    """Part of an image that a generator sees, px: rows `top` up to `bottom`, columns `left` up to `right`."""

    top: int
    bottom: int
    left: int
    right: int

    def __post_init__(self) -> None:
        if min(self.top, self.left) < 0 or self.bottom - self.top < MIN_SIDE or self.right - self.left < MIN_SIDE:
            raise Sim2RealError(f"crop {self}: expected at least {MIN_SIDE} rows and columns, none of them negative")

    def __str__(self) -> str:
        return f"rows {self.top} to {self.bottom}, columns {self.left} to {self.right}"


def generator_input(image: NDArray[np.uint8], window: Window, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Cut a window out of an image, (rows, columns, 3) uint8 RGB, and resize it to `size`, rows and columns."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise Sim2RealError(f"image of shape {image.shape} and type {image.dtype}, expected (rows, columns, 3) uint8")
    if window.bottom > image.shape[0] or window.right > image.shape[1]:
        raise Sim2RealError(
            f"image of {image.shape[0]} x {image.shape[1]} px, expected one with {window}: it comes from another camera"
        )
    return resize(image[window.top : window.bottom, window.left : window.right], size)


def resize(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize to rows and columns: by areas where the image shrinks in both directions, else bilinearly."""
    rows, columns = image.shape[:2]
    if (rows, columns) == size:
        return np.ascontiguousarray(image)
    method = cv2.INTER_AREA if rows >= size[0] and columns >= size[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=method), np.uint8)


@dataclass(frozen=True, kw_only=True)
class StoredGenerator:
    """Generator from a file: it sees `window` of a simulator's images, and learnt from `real_window` of photographs."""

    simulator: str
    shape: GeneratorShape
    window: Window
    real_window: Window
    tensors: dict[str, NDArray[np.float32]]
    content: bytes = field(repr=False)

    @property
    def sha256(self) -> str:
        """Digest of the file."""
        return hashlib.sha256(self.content).hexdigest()


def tensor_shapes(shape: GeneratorShape) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of a generator's tensors."""
    f, up = shape.filters, 10 + shape.blocks
    weights = {"1": (f, 3, 7, 7), "4": (2 * f, f, 3, 3), "7": (4 * f, 2 * f, 3, 3)}
    weights |= {f"{block}.body.{part}": (4 * f, 4 * f, 3, 3) for block in range(10, up) for part in (1, 5)}
    weights |= {f"{up}": (4 * f, 2 * f, 3, 3), f"{up + 3}": (2 * f, f, 3, 3), f"{up + 7}": (3, f, 7, 7)}
    # Transposed convolutions have their inputs first.
    biases = {layer: (size[layer in (f"{up}", f"{up + 3}")],) for layer, size in weights.items()}
    return {f"layers.{layer}.weight": size for layer, size in weights.items()} | {
        f"layers.{layer}.bias": size for layer, size in biases.items()
    }


def save_generator(
    path: Path,
    tensors: dict[str, NDArray[np.float32]],
    *,
    simulator: str,
    shape: GeneratorShape,
    window: Window,
    real_window: Window,
) -> None:
    """Write a generator's weights as float16."""
    windows = {"window": asdict(window), "real_window": asdict(real_window)}
    # One entry, as the order of several is that of a hash table, which differs between processes.
    metadata = {KIND: json.dumps({"simulator": simulator, "shape": asdict(shape), **windows})}
    # The format has no strides and its writer does not look at them: weights trained channels last would be permuted.
    halves = {name: np.ascontiguousarray(value, np.float16) for name, value in tensors.items()}
    write_whole(path, save(halves, metadata=metadata))


def load_generator(path: Path) -> StoredGenerator:
    """Load a generator.

    Raises:
        Sim2RealError: the file is missing, damaged, or no generator.
    """
    if not path.is_file():
        raise Sim2RealError(f"{path}: no such generator: expected a .safetensors file of `ds sim2real train`")
    if path.stat().st_size > LARGEST_FILE:
        raise Sim2RealError(f"{path} has more than {LARGEST_FILE // 2**20} MiB: expected a generator")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
        if KIND not in metadata:
            raise Sim2RealError(f"{path} is no generator: expected a file of `ds sim2real train`")
        about: dict[str, Any] = load_json(metadata[KIND])
        shape = GeneratorShape(**{name: _whole(value) for name, value in about["shape"].items()})
        window, real_window = (
            Window(**{name: _whole(value) for name, value in about[key].items()}) for key in ("window", "real_window")
        )
        if not (
            1 <= shape.filters <= MOST_FILTERS
            and 0 <= shape.blocks <= MOST_BLOCKS
            and min(shape.size) >= 16
            and shape.rows * shape.columns <= MOST_PIXELS
            and shape.rows % 4 == shape.columns % 4 == 0
        ):
            raise ValueError(f"size {shape}")
        content = read_regular(path, LARGEST_FILE)
        tensors = {name: np.asarray(value, np.float32) for name, value in load(content).items()}
        if {name: value.shape for name, value in tensors.items()} != tensor_shapes(shape):
            raise ValueError("its tensors do not fit its size")
        simulator = str(about["simulator"])
    except Sim2RealError:
        raise
    except Exception as error:  # damaged files make the reader raise arbitrary errors
        text = " ".join(str(error).split())[:200]
        raise Sim2RealError(f"{path} cannot be read ({text}): the file is damaged, copy it again") from None
    if not all(bool(np.isfinite(value).all()) for value in tensors.values()):
        raise Sim2RealError(f"{path} holds NaN or infinity: train the generator again")
    return StoredGenerator(
        simulator=simulator, shape=shape, window=window, real_window=real_window, tensors=tensors, content=content
    )


def _whole(value: object) -> int:
    if type(value) is not int:
        raise ValueError(f"{value!r:.40} is not a whole number")
    return value
