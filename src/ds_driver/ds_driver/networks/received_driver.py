# SPDX-License-Identifier: Apache-2.0
"""Decides which drivers a received file may name."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from ds_base.extension import installed
from ds_driver.networks.description import file_of, read_description
from ds_driver.networks.driver_name import AUTOPILOT, DESCRIPTIONS, WEIGHTS, DriverName
from ds_driver.networks.network_file import KINDS
from ds_driver.networks.pilot import DriverError
from ds_driver.networks.weights import shipped_networks


def received_driver(driver: DriverName, *, confirmed: Collection[str] = ()) -> DriverName:
    """Check and return a driver that a received file names, before anything is loaded.

    The autopilot, shipped networks, safetensors weights, and described ONNX or TensorFlow Lite files run no code of
    their own. A Python class runs its module, and a TorchScript file is a program that can write files: such a name is
    among the `confirmed` ones that the user gave with `--trust` or in a configuration.

    Raises:
        DriverError: it would run unconfirmed code, or has no readable description.
    """
    text, name, suffix = str(driver), driver.network, driver.file_type
    harmless = driver == AUTOPILOT or name in shipped_networks() or name in installed("drivers") or suffix == WEIGHTS
    if harmless or text in confirmed or name in confirmed:
        return driver
    if suffix in DESCRIPTIONS:
        path = Path(name)
        if KINDS[file_of(path, read_description(path)).suffix.lower()] != "torchscript":
            return driver
        what = "a TorchScript file, which is a program,"
    elif ":" in name:
        what = "Python code that is not shipped,"
    else:
        return driver  # an architecture without weights, or not loadable at all
    shown = repr(text) if len(text) <= 100 else f"{text[:100]!r}..."
    raise DriverError(
        f"driver {shown} is {what} and a received file must not run code: if you trust it, name it yourself with "
        f"--trust {shown}"
    )
