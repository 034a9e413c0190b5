"""Network weights as safetensors: no pickle, the architecture's name inside, half precision on disk."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from ds_driver.networks.architectures import NETWORKS, UnknownNetworkError, make_network

SHIPPED = Path(__file__).parents[1] / "models"
"""Where the networks that come with the package lie."""


class WeightsError(ValueError):
    """A weights file that is missing, damaged, or of another architecture."""


def shipped_networks() -> dict[str, Path]:
    """Name -> weights file of every network that comes with the package."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.safetensors"))}


def save_weights(network: nn.Module, path: Path, *, architecture: str, notes: dict[str, str] | None = None) -> None:
    """Write a network's weights as float16, which halves the file; `load_network` gives float32 back."""
    tensors = {name: value.detach().to(torch.float16).contiguous() for name, value in network.state_dict().items()}
    partial = path.with_suffix(".partial")
    save_file(tensors, partial, metadata={"architecture": architecture, **(notes or {})})
    partial.replace(path)


def weights_sha256(name_or_path: str) -> str:
    """Hash of the weights file that `load_network` would read."""
    return hashlib.sha256(_path_of(name_or_path).read_bytes()).hexdigest()


def _path_of(name_or_path: str) -> Path:
    """The weights file of a name or path.

    Raises:
        WeightsError: it is missing.
        UnknownNetworkError: neither a known name nor a weights file's.
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
    return path


def load_network(name_or_path: str) -> nn.Module:
    """Load a shipped network by name, or any weights file of ours by path; in evaluation mode, float32.

    Raises:
        WeightsError: the file is missing, truncated, not ours, or does not fit its architecture.
        UnknownNetworkError: neither a known name nor an existing file.
    """
    path = _path_of(name_or_path)
    try:
        with safe_open(path, framework="pt") as file:
            architecture = (file.metadata() or {}).get("architecture", "")
            tensors = {key: file.get_tensor(key).float() for key in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError) as error:
        raise WeightsError(
            f"weights {path.name} cannot be read ({error}): the file is damaged, copy it again"
        ) from None
    if architecture not in NETWORKS:
        raise WeightsError(
            f"weights {path.name} name the architecture {architecture!r}: expected one of {', '.join(NETWORKS)}"
        )
    network = make_network(architecture)
    try:
        network.load_state_dict(tensors)
    except RuntimeError:
        raise WeightsError(f"weights {path.name} do not fit {architecture}: they belong to another network") from None
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise WeightsError(f"weights {path.name} hold NaN or infinity: train the network again")
    return network.eval()
