"""The file of a fitted car: YAML that a person can read and `donkey@FILE` drives with."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from ds_twin_donkey.fit import Fit
from ds_twin_donkey.logs import CHANNELS, Log
from ds_twin_donkey.parameters import DonkeyParameters

FORMAT = "ds_twin_donkey parameters 1"
_UNITS = dict(zip(CHANNELS, ("m", "m", "rad", "m/s", "rad/s"), strict=True))


class ParameterFileError(ValueError):
    """A file that holds no parameters of this car."""


def document_of(fit: Fit, logs: Sequence[Log]) -> dict[str, Any]:
    """A fit as JSON values: each parameter with what is known about it, the logs, and what the fit leaves over."""
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
            name: {"value": _short(value), "noise": _short(fit.noise[name]), "unit": _UNITS[name]}
            for name, value in fit.rms.items()
            if math.isfinite(value)
        },
    }


def write_parameters(path: Path, document: dict[str, Any]) -> None:
    """Write what `document_of` gives; SI units of the model car.

    Raises:
        OSError: the file cannot be written.
    """
    head = (
        "# Parameters of the 1:16 car, fitted to recorded drives. SI units of the model car.\n"
        "# Drive with them by naming the simulator donkey@THIS_FILE. Status: fitted (95 % interval within 5 %),\n"
        "# weakly fitted (wider), not determined by these logs (left at the start), or held (not fitted).\n"
    )
    path.write_text(head + yaml.safe_dump(document, sort_keys=False, width=120))


def read_parameters(path: Path) -> tuple[DonkeyParameters, str]:
    """The car of a file and the file's SHA-256.

    Raises:
        ParameterFileError: in one line, what is wrong with it.
    """
    try:
        content = path.read_bytes()
        raw = yaml.safe_load(content)
    except OSError as error:
        raise ParameterFileError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ParameterFileError(f"{path}: not YAML ({' '.join(str(error).split())})") from None
    if not isinstance(raw, dict) or raw.get("format") != FORMAT or not isinstance(raw.get("parameters"), dict):
        raise ParameterFileError(f"{path}: not a file of {FORMAT!r}: write one with `ds twin fit`")
    values = {}
    for name, row in raw["parameters"].items():
        value = row.get("value") if isinstance(row, dict) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ParameterFileError(f"{path}: {name} has the value {value!r}, expected a number under `value`")
        values[str(name)] = value
    try:
        return DonkeyParameters().changed(**values), hashlib.sha256(content).hexdigest()
    except ValueError as error:
        raise ParameterFileError(f"{path}: {error}") from None


def _short(value: float) -> float:
    """Six digits; more say nothing."""
    return float(f"{value:.6g}")
