# SPDX-License-Identifier: Apache-2.0
"""The multi-body model as its authors publish it: parameter sets and right-hand side of `commonroad-vehicle-models`.

Equations and parameters are explained in Althoff, Wuersching: CommonRoad: Vehicle Models, 2020.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

PACKAGE = "commonroad-vehicle-models"
VERSION = "3.0.2"
"""Version of the package whose functions `integration` compiles."""

STATES = 29
"""Length of the state."""
X, Y, STEERING, SPEED, YAW, YAW_RATE, ROLL, PITCH, LATERAL_SPEED, HEAVE = 0, 1, 2, 3, 4, 5, 6, 8, 10, 11
"""Sprung mass: position of its centre, velocity along its own axes, attitude (y left, but roll, pitch and z as in a
vehicle's axes with z down: roll left side down positive, pitch nose up positive, heave downwards)."""
FRONT_LATERAL_SPEED, REAR_LATERAL_SPEED = 15, 20
"""Lateral velocities of the axles."""
WHEEL_SPEEDS = 23
"""First of the four wheels' angular velocities: left front, right front, left rear, right rear."""
FRONT_OFFSET, REAR_OFFSET = 27, 28
"""Distance to the left of the axles by which the sprung mass has moved on their compliant joints."""


def check_version() -> None:
    """Refuse, by an ImportError, another version of the package than that which this project was tested with."""
    try:
        installed = metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        installed = "not installed"
    if installed != VERSION:
        raise ImportError(f"{PACKAGE} is {installed}, expected {VERSION}: pip install {PACKAGE}=={VERSION}")


@cache
def parameter_set(number: int) -> Any:
    """Read a published set, of a Ford Escort, BMW 320i or VW Vanagon (1 to 3), in SI units; do not change it."""
    from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

    return setup_vehicle_parameters(number)


def rest_state(number: int) -> NDArray[np.float64]:
    """State by the package's `init_mb`, (29,), at rest at the origin, before it has settled on its springs."""
    from vehiclemodels.init_mb import init_mb

    return np.array(init_mb([0.0] * 7, parameter_set(number)), dtype=np.float64)


def record(values: Any, **changed: Any) -> Any:
    """Copy the numbers of a dataclass, and of those inside it, to a NumPy record that compiled code can read.

    Fields that are None are left out; `changed` replaces fields, by a mapping in a dataclass inside.
    """
    numbers = dataclasses.asdict(values, dict_factory=_numbers)
    for name, value in changed.items():
        numbers[name] = {**numbers[name], **value} if isinstance(value, dict) else value
    return np.array(_row(numbers), dtype=_layout(numbers))[()]


def _numbers(fields: list[tuple[str, Any]]) -> dict[str, Any]:
    return {name: value for name, value in fields if value is not None and value != {}}


def _row(numbers: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(_row(v) if isinstance(v, dict) else float(v) for v in numbers.values())


def _layout(numbers: dict[str, Any]) -> np.dtype[np.void]:
    return np.dtype([(k, _layout(v) if isinstance(v, dict) else np.float64) for k, v in numbers.items()])
