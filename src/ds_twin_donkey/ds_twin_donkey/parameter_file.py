# SPDX-License-Identifier: Apache-2.0
"""Reads and writes the YAML parameter file of a fitted car, which the simulator `donkey@FILE` loads."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from ds_base.bounded_file import FileError, read_regular
from ds_base.bounded_yaml import DEFAULT_LIMITS, load_yaml
from ds_base.errors import InputError
from ds_base.folder_files import write_whole
from ds_twin_donkey.parameters import DonkeyParameters

if TYPE_CHECKING:  # whoever drives needs no part of SciPy, which takes half a second to import
    from ds_twin_donkey.fit import TwinFit
    from ds_twin_donkey.logs import Log

FORMAT = "ds_twin_donkey parameters 1"


class ParameterFileError(InputError):
    """The file holds no parameters of this car."""


def document_of(fit: TwinFit, logs: Sequence[Log]) -> dict[str, Any]:
    """Convert a fit to JSON values: each parameter with its status and interval, the logs, and the residuals."""
    from ds_twin_donkey.logs import CHANNELS

    units = dict(zip(CHANNELS, ("m", "m", "rad", "m/s", "rad/s"), strict=True))
    estimates = {estimate.name: estimate for estimate in fit.estimates}
    parameters: dict[str, dict[str, Any]] = {}
    for field in dataclasses.fields(DonkeyParameters):
        value = getattr(fit.parameters, field.name)
        estimate = estimates.get(field.name)
        if estimate is None:
            parameters[field.name] = {"value": value, "status": "held"}
            continue
        row: dict[str, Any] = {"value": _short(estimate.value), "unit": estimate.unit}
        row["status"] = estimate.status
        if estimate.determined:
            row["interval_95"] = [_short(estimate.low), _short(estimate.high)]
        parameters[field.name] = row | {"start": _short(estimate.start)}
    return {
        "format": FORMAT,
        "parameters": parameters,
        "logs": [
            {"name": log.name, "kind": log.kind, "sha256": log.sha256, "seconds": round(log.seconds, 2)} for log in logs
        ],
        "windows": fit.windows,
        "rms_residuals": {
            name: {"value": _short(value), "noise": _short(fit.noise[name]), "unit": units[name]}
            for name, value in fit.rms.items()
            if math.isfinite(value)
        },
    }


def write_parameters(path: Path, document: dict[str, Any]) -> None:
    """Write a document of `document_of`, in SI units of the model car."""
    head = (
        "# Parameters of the 1:16 car, fitted to recorded drives. SI units of the model car.\n"
        "# Drive with them by naming the simulator donkey@THIS_FILE. Status: fitted (95% interval within 5%),\n"
        "# weakly fitted (wider), not determined by these logs (left at the start), or held (not fitted).\n"
    )
    write_whole(path, head + yaml.safe_dump(document, sort_keys=False, width=120))


def read_parameters(path: Path) -> tuple[DonkeyParameters, str]:
    """Read the parameters of a car and the SHA-256 of their file; ParameterFileError if it is no such file."""
    try:
        content = read_regular(path, DEFAULT_LIMITS.size)
        raw = load_yaml(content, unique_keys=True)
    except OSError as error:
        raise ParameterFileError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except FileError as error:
        raise ParameterFileError(f"{path}: not YAML ({error})") from None
    if not isinstance(raw, dict) or raw.get("format") != FORMAT or not isinstance(raw.get("parameters"), dict):
        raise ParameterFileError(f"{path}: not a file of {FORMAT!r}: write one with `ds twin fit`")
    values = {}
    for name, row in raw["parameters"].items():
        value = row.get("value") if isinstance(row, dict) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ParameterFileError(
                f"{path}: {name!s:.60} has the value {value!r:.60}, expected a number under `value`"
            )
        values[str(name)] = value
    try:
        return DonkeyParameters().changed(**values), hashlib.sha256(content).hexdigest()
    except ValueError as error:
        raise ParameterFileError(f"{path}: {' '.join(str(error).split()):.1000}") from None


def _short(value: float) -> float:
    """Round to six digits."""
    return float(f"{value:.6g}")
