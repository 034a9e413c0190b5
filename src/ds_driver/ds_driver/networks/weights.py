"""Stores network weights as safetensors, without pickle: half precision, the architecture in the metadata."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from ds_driver.networks.architectures import NETWORKS, UnknownNetworkError, make_network

SHIPPED = Path(__file__).parents[1] / "models"
"""Folder of the shipped networks."""
LARGEST_FILE = 2**29
"""Bytes of a weights file; chosen: ten times the largest shipped one."""
_NUMBERS = ("F16", "BF16", "F32", "F64")


class WeightsError(ValueError):
    """The weights file is missing, damaged, or of another architecture."""


def shipped_networks() -> dict[str, Path]:
    """Return the shipped networks: name -> weights file."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.safetensors"))}


def save_weights(network: nn.Module, path: Path, *, architecture: str, notes: dict[str, str] | None = None) -> None:
    """Write a network's weights as float16, which halves the file; `load_network` returns float32."""
    tensors = {name: value.detach().to(torch.float16).contiguous() for name, value in network.state_dict().items()}
    partial = path.with_suffix(".partial")
    save_file(tensors, partial, metadata={"architecture": architecture, **(notes or {})})
    partial.replace(path)


def weights_sha256(name_or_path: str) -> str:
    """Compute the SHA-256 of the weights file that `load_network` would read."""
    return hashlib.sha256(_path_of(name_or_path).read_bytes()).hexdigest()


def architecture_in(path: Path) -> str:
    """Read the architecture from the metadata of a weights file; "" if there is none."""
    if not path.is_file():
        return ""
    try:
        with safe_open(path, framework="pt") as file:
            return str((file.metadata() or {}).get("architecture", ""))
    except Exception:  # files of other formats can raise anything
        return ""


def _path_of(name_or_path: str) -> Path:
    """Return the weights file of a name or path.

    Raises:
        WeightsError: the file is missing or too large.
        UnknownNetworkError: neither a known name nor the path of a weights file.
    """
    path = Path(name_or_path)
    if name_or_path in NETWORKS or name_or_path in shipped_networks():
        path = SHIPPED / f"{name_or_path}.safetensors"
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


def load_network(name_or_path: str) -> nn.Module:
    """Load a shipped network by name, or a weights file by path; in evaluation mode, float32.

    Raises:
        WeightsError: the file is missing, damaged, in another format, or does not fit its architecture.
        UnknownNetworkError: neither a known name nor an existing file.
    """
    path = _path_of(name_or_path)
    try:
        with safe_open(path, framework="pt") as file:
            architecture = (file.metadata() or {}).get("architecture", "")
            if architecture not in NETWORKS:
                raise WeightsError(
                    f"weights {path.name} name the architecture {architecture!r:.60}: expected one of "
                    f"{', '.join(NETWORKS)}"
                )
            network = make_network(architecture)
            expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            found = {name: tuple(part.get_shape()) for name, part in slices.items()}
            if found != expected or any(part.get_dtype() not in _NUMBERS for part in slices.values()):
                raise WeightsError(f"weights {path.name} do not fit {architecture}: they belong to another network")
            tensors = {name: file.get_tensor(name).float() for name in found}
    except WeightsError:
        raise
    except Exception as error:  # damaged files make the reader raise arbitrary errors
        raise WeightsError(
            f"weights {path.name} cannot be read ({' '.join(str(error).split()):.200}): the file is damaged, copy it "
            "again"
        ) from None
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise WeightsError(f"weights {path.name} hold NaN or infinity: train the network again")
    network.load_state_dict(tensors)
    return network.eval()
