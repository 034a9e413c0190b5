"""Stores generators: safetensors in half precision that say what they translate, and a JSON card beside them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save

from ds_driver.sim2real.shape import GeneratorShape
from ds_driver.sim2real.window import Sim2RealError, Window
from ds_driver.whole_files import write_whole

KIND = "sim2real generator 1"
"""Key of the metadata, and format of the file."""
LARGEST_FILE = 2**28
"""Bytes of a generator's file; chosen: ten times the paper's size in half precision."""
MOST_FILTERS, MOST_BLOCKS, MOST_PIXELS = 256, 32, 2**22


@dataclass(frozen=True, kw_only=True)
class StoredGenerator:
    """Generator from a file.

    Attributes:
        simulator: name of the simulator whose images it translates.
        shape: size.
        window: part of the simulator's images that it sees.
        real_window: part of the photographs that it learnt from.
        tensors: name -> float32 values.
        content: of the file.
    """

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
    f, found = shape.filters, {"layers.1.weight": (shape.filters, 3, 7, 7), "layers.1.bias": (shape.filters,)}
    for layer, channels in ((4, f), (7, 2 * f)):
        found |= {
            f"layers.{layer}.weight": (2 * channels, channels, 3, 3),
            f"layers.{layer}.bias": (2 * channels,),
        }
    for block in range(10, 10 + shape.blocks):
        for part in (1, 5):
            found[f"layers.{block}.body.{part}.weight"] = (4 * f, 4 * f, 3, 3)
            found[f"layers.{block}.body.{part}.bias"] = (4 * f,)
    up = 10 + shape.blocks
    for layer, channels in ((up, 4 * f), (up + 3, 2 * f)):
        found |= {
            f"layers.{layer}.weight": (channels, channels // 2, 3, 3),
            f"layers.{layer}.bias": (channels // 2,),
        }
    return found | {f"layers.{up + 7}.weight": (3, f, 7, 7), f"layers.{up + 7}.bias": (3,)}


def save_generator(
    path: Path,
    tensors: dict[str, NDArray[np.float32]],
    *,
    simulator: str,
    shape: GeneratorShape,
    window: Window,
    real_window: Window,
) -> None:
    """Write a generator's weights as float16, in a file that appears whole or not at all."""
    about = {
        "simulator": simulator,
        "shape": asdict(shape),
        "window": asdict(window),
        "real_window": asdict(real_window),
    }
    # One entry, as the order of several is that of a hash table, which differs between processes.
    metadata = {KIND: json.dumps(about)}
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
            about: dict[str, Any] = json.loads(metadata[KIND])
            shape = GeneratorShape(**{name: _whole(value) for name, value in about["shape"].items()})
            windows = [
                Window(**{name: _whole(value) for name, value in about[key].items()})
                for key in ("window", "real_window")
            ]
            if not (
                1 <= shape.filters <= MOST_FILTERS
                and 0 <= shape.blocks <= MOST_BLOCKS
                and min(shape.size) >= 16
                and shape.rows * shape.columns <= MOST_PIXELS
                and shape.rows % 4 == shape.columns % 4 == 0
            ):
                raise ValueError(f"size {shape}")
            names = list(file.keys())
            if {name: tuple(file.get_slice(name).get_shape()) for name in names} != tensor_shapes(shape):
                raise ValueError("its tensors do not fit its size")
            tensors = {name: np.asarray(file.get_tensor(name), np.float32) for name in names}
            simulator = str(about["simulator"])
    except Sim2RealError:
        raise
    except Exception as error:  # damaged files make the reader raise arbitrary errors
        text = " ".join(str(error).split())[:200]
        raise Sim2RealError(f"{path} cannot be read ({text}): the file is damaged, copy it again") from None
    if not all(bool(np.isfinite(value).all()) for value in tensors.values()):
        raise Sim2RealError(f"{path} holds NaN or infinity: train the generator again")
    return StoredGenerator(
        simulator=simulator,
        shape=shape,
        window=windows[0],
        real_window=windows[1],
        tensors=tensors,
        content=path.read_bytes(),
    )


def check_fits(generator: StoredGenerator, simulator: str) -> None:
    """Refuse a generator for the images of another simulator.

    Raises:
        Sim2RealError: the generator was trained for another simulator.
    """
    if generator.simulator != simulator:
        raise Sim2RealError(
            f"the generator translates images of {generator.simulator}, these are of {simulator}: choose the "
            f"generator of {simulator}, or train one"
        )


def _whole(value: object) -> int:
    if type(value) is not int:
        raise ValueError(f"{value!r:.40} is not a whole number")
    return value
