"""Splits a driver's name, `NETWORK+GENERATORS@BACKEND`, without loading anything."""

from __future__ import annotations

from pathlib import Path

from ds_driver.networks.architectures import NETWORKS
from ds_driver.networks.backends import split_backend
from ds_driver.networks.weights import shipped_networks

DESCRIPTIONS = (".yaml", ".yml")
"""Suffixes of the description of a network file."""


def split_generators(name: str) -> tuple[str, str]:
    """Split a driver's name without backend: `dave2+FOLDER` into `dave2` and `FOLDER`, `dave2` into itself and ""."""
    networks = {**NETWORKS, **shipped_networks()}
    for place in (index for index, character in enumerate(name) if character == "+"):
        network = name[:place]
        suffix = Path(network).suffix.lower()
        if network in networks or suffix in (".safetensors", *DESCRIPTIONS) or (":" in network and place > 1):
            return network, name[place + 1 :]
    return name, ""


def with_generators(driver: str, generators: str) -> str:
    """Append a set of generators to a driver's name; "" leaves it as it is."""
    if not generators:
        return driver
    name = split_backend(driver)[0]
    return f"{split_generators(name)[0]}+{generators}{driver[len(name) :]}"
