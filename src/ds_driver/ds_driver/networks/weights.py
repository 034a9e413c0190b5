# SPDX-License-Identifier: Apache-2.0
"""Reads network weights from safetensors; the architecture is in the metadata, and large layers may be in 8 bits."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import deserialize, safe_open

from ds_base.bounded_file import load_json, read_regular, sha256_of
from ds_base.errors import InputError
from ds_base.installation import install_command, wheel_version
from ds_driver.networks.architectures import NETWORKS, Architecture, UnknownNetworkError

SHIPPED = Path(__file__).parents[1] / "models"
"""Folder of the shipped networks."""
APART = ("dave2_real", "dave2_real_short", "dave2_short", "epoch", "epoch_real")
"""Shipped networks that the wheel leaves to the distribution `digital-siblings-networks`."""
LARGEST_FILE = 2**29
"""Bytes of a weights file; chosen: ten times the largest shipped one."""
GENERATORS = "sim2real"
"""Folder of generators: that of the shipped sets, and the one beside a network's weights."""
TRANSLATED = "network for translated images 1"
"""Key of the metadata of a network that was trained on translated images."""
_FLOAT32: dict[str, Callable[[bytes], NDArray[np.float32]]] = {
    "F16": lambda data: np.frombuffer(data, "<f2").astype(np.float32),
    # The upper half of a float32.
    "BF16": lambda data: (np.frombuffer(data, "<u2").astype(np.uint32) << 16).view(np.float32),
    "F32": lambda data: np.frombuffer(data, "<f4").astype(np.float32),
    "F64": lambda data: np.frombuffer(data, "<f8").astype(np.float32),
    "I8": lambda data: np.frombuffer(data, np.int8).astype(np.float32),
}
"""Number type in a file -> what reads it; those of 8 bits come with scales."""
SCALE = ".scale"
"""End of the name of a tensor of scales."""


class WeightsError(InputError):
    """The weights file is missing, damaged, or of another architecture."""


@dataclass(frozen=True, slots=True)
class Weights:
    """Trained weights by the names of `Architecture.shapes`; `name` is that of the shipped network, or the file's."""

    name: str
    architecture: Architecture
    tensors: dict[str, NDArray[np.float32]]


def shipped_networks() -> dict[str, Path]:
    """Return the shipped networks: name -> weights file, or description of a network file.

    Examples:
        >>> from ds_driver import shipped_networks
        >>> "dave2" in shipped_networks()
        True
    """
    return {path.stem: path for path in sorted((*SHIPPED.glob("*.safetensors"), *SHIPPED.glob("*.yaml")))}


def shipped_sets() -> dict[str, Path]:
    """Return the shipped sets of generators: name -> folder."""
    return {path.name: path for path in sorted((SHIPPED / GENERATORS).glob("*")) if any(path.glob("*.safetensors"))}


def weights_sha256(name_or_path: str) -> str:
    """Compute the SHA-256 of the weights file that `load_weights` would read."""
    return sha256_of([path_of_weights(name_or_path)])


def metadata_of(architecture: str, generators: dict[str, str]) -> dict[str, str]:
    """Return the metadata of weights; generators, simulator -> SHA-256, translated its images, none if empty."""
    if not generators:
        return {"architecture": architecture}
    # One entry, as the order of several is that of a hash table, which differs between processes.
    return {TRANSLATED: json.dumps({"architecture": architecture, "generators": generators}, sort_keys=True)}


def architecture_in(path: Path) -> str:
    """Read the architecture from the metadata of a weights file; "" if there is none."""
    return _about(path)[0]


def generators_in(name_or_path: str) -> dict[str, str]:
    """Read which generators, simulator -> SHA-256, a network was trained with; errors of `path_of_weights`."""
    return _about(path_of_weights(name_or_path))[1]


def _about(path: Path) -> tuple[str, dict[str, str]]:
    if not path.is_file():
        return "", {}
    try:
        with safe_open(path, framework="numpy") as file:
            return _read_metadata(file.metadata() or {})
    except Exception:  # files of other formats can raise anything
        return "", {}


def _read_metadata(metadata: dict[str, str]) -> tuple[str, dict[str, str]]:
    if TRANSLATED not in metadata:
        return str(metadata.get("architecture", "")), {}
    about: dict[str, Any] = load_json(metadata[TRANSLATED])
    return str(about["architecture"]), {str(name): str(digest) for name, digest in about["generators"].items()}


def path_of_weights(name_or_path: str) -> Path:
    """Return the weights file of a name or path; a WeightsError or UnknownNetworkError if it cannot be read as one."""
    path = Path(name_or_path)
    if name_or_path in APART and name_or_path not in shipped_networks() and wheel_version() is not None:
        raise WeightsError(f"{name_or_path} is one of the large networks: {install_command('networks')}")
    if name_or_path in NETWORKS or name_or_path in shipped_networks():
        path = shipped_networks().get(name_or_path, SHIPPED / f"{name_or_path}.safetensors")
        if path.suffix != ".safetensors":
            raise UnknownNetworkError(f"{name_or_path} is described, and has no weights to continue from")
        if not path.exists():
            raise WeightsError(f"weights of {name_or_path} are missing ({path.name}): train them with `ds train`")
    elif path.suffix != ".safetensors":
        raise UnknownNetworkError(
            f"unknown network {name_or_path!r}: expected one of {', '.join({**NETWORKS, **shipped_networks()})}, or a "
            ".safetensors file"
        )
    elif not path.is_file():
        raise WeightsError(f"weights {name_or_path!r} are missing: check the path")
    if path.stat().st_size > LARGEST_FILE:
        raise WeightsError(
            f"weights {path.name} have more than {LARGEST_FILE // 2**20} MiB: expected the weights of a network"
        )
    return path


def load_weights(name_or_path: str) -> Weights:
    """Load the weights of a shipped network by name, or of a file by path.

    Raises:
        WeightsError: the file is damaged, in another format, or does not fit its architecture; see `path_of_weights`.
    """
    path = path_of_weights(name_or_path)
    try:
        with safe_open(path, framework="numpy") as file:
            name, _ = _read_metadata(file.metadata() or {})
        if name not in NETWORKS:
            raise WeightsError(
                f"weights {path.name} name the architecture {name!r:.60}: expected one of {', '.join(NETWORKS)}"
            )
        parts = dict(deserialize(read_regular(path, LARGEST_FILE)))  # type: ignore[no-untyped-call]
        shapes = NETWORKS[name].shapes()
        # Matrices of 8 bits, and no other tensors, have scales, one per row.
        shapes |= {key + SCALE: shapes.get(key, ())[:-1] for key, part in parts.items() if part["dtype"] == "I8"}
        types = {part["dtype"] for part in parts.values()}
        if {key: tuple(part["shape"]) for key, part in parts.items()} != shapes or not types <= set(_FLOAT32):
            raise WeightsError(f"weights {path.name} do not fit {name}: they belong to another network")
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinity, which is refused below
            stored = {key: _FLOAT32[part["dtype"]](part["data"]).reshape(part["shape"]) for key, part in parts.items()}
            tensors = _expanded(stored)
    except WeightsError:
        raise
    except Exception as error:  # damaged files make the reader raise arbitrary errors
        raise WeightsError(
            f"weights {path.name} cannot be read ({' '.join(str(error).split()):.200}): the file is damaged, copy it "
            "again"
        ) from None
    if not all(bool(np.isfinite(tensor).all()) for tensor in tensors.values()):
        raise WeightsError(f"weights {path.name} hold NaN or infinity: train the network again")
    return Weights(name_or_path, NETWORKS[name], tensors)


def _expanded(tensors: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    """Multiply stored integers, already as float32, by their rows' scales; other tensors stay as they are."""
    return {
        key: value * tensors[key + SCALE][:, None] if key + SCALE in tensors else value
        for key, value in tensors.items()
        if not key.endswith(SCALE)
    }
