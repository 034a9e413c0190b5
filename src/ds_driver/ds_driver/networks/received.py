"""Decides which drivers a received file may name: only those that run no code of its author."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from ds_driver.networks.described_network import KINDS, file_of, read_description
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.pilot import DriverError
from ds_driver.networks.weights import shipped_networks

AUTOPILOT = "autopilot"


def received_driver(driver: object, *, confirmed: Collection[str] = (), option: str = "--trust") -> str:
    """Check a driver's name that was read from a received file, before anything is loaded.

    The autopilot, shipped networks, safetensors weights, and described ONNX or TensorFlow Lite files run no code of
    their own. A Python class runs its module, and a TorchScript file is a program that can write files: the user has
    to confirm such a name with an option.

    Args:
        driver: name in the file.
        confirmed: names that the user gave on the command line or in their own configuration.
        option: command line option that confirms a name, for the message.

    Returns:
        The name, safe to load.

    Raises:
        DriverError: the name is not text, would run unconfirmed code, or has no readable description.
    """
    if not isinstance(driver, str):
        raise DriverError(f"driver is a {type(driver).__name__}, expected a name")
    name = DriverName.parse(driver).network
    suffix = Path(name).suffix.lower()
    harmless = name == AUTOPILOT or name in shipped_networks() or suffix == ".safetensors"
    if harmless or driver in confirmed or name in confirmed:
        return driver
    if suffix in (".yaml", ".yml"):
        path = Path(name)
        if KINDS[file_of(path, read_description(path)).suffix.lower()] != "torchscript":
            return driver
        what = "a TorchScript file, which is a program,"
    elif ":" in name:
        what = "Python code that is not shipped,"
    else:
        return driver  # an architecture without weights, or not loadable at all
    shown = repr(driver) if len(driver) <= 100 else f"{driver[:100]!r}..."
    raise DriverError(
        f"driver {shown} is {what} and a received file must not run code: if you trust it, name it yourself with "
        f"{option} {shown}"
    )
