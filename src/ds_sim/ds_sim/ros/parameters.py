# SPDX-License-Identifier: Apache-2.0
"""Declares ROS parameters of nodes with descriptions and ranges; a bad value gives an error of one line."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

_TYPE_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


def declare(
    node: Node,
    name: str,
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[str] = (),
    length: int | None = None,
) -> Any:
    """Declare a read-only parameter of a node and return its value.

    The default decides the type: bool, int, float, str, or a list of one of them. Of a list, the bounds and choices are
    those of each entry, and the length is that of the node's namespaces. The description has the unit. ValueError for a
    value of another type or out of range.
    """
    kind = type(default[0] if isinstance(default, list) else default)
    descriptor = ParameterDescriptor(description=description, read_only=True)
    descriptor.additional_constraints = _constraints(low, high, choices)
    if not isinstance(default, list) and (low is not None or high is not None):
        if kind is int:
            bounds = IntegerRange(from_value=int(low or 0), to_value=2**31 if high is None else int(high), step=1)
            descriptor.integer_range = [bounds]
        else:
            top = sys.float_info.max if high is None else float(high)
            bottom = -sys.float_info.max if low is None else float(low)
            descriptor.floating_point_range = [FloatingPointRange(from_value=bottom, to_value=top, step=0.0)]
    try:
        value = node.declare_parameter(name, default, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException):
        override = node._parameter_overrides[name].value
        wanted = descriptor.additional_constraints or f"{'a list of ' * isinstance(default, list)}{_TYPE_NAMES[kind]}"
        hint = ", written with a point such as 5.0" if kind is float and isinstance(override, int | list) else ""
        raise ValueError(f"parameter {name} is {override!r}: expected {wanted}{hint}") from None
    values = value if isinstance(default, list) else [value]
    if length is not None and len(values) != length:
        raise ValueError(f"parameter {name} has {len(values)} entries: give one for each of the {length} namespaces")
    for entry in values:
        if not _fits(entry, low, high, choices):
            raise ValueError(f"parameter {name} is {entry!r}: expected {descriptor.additional_constraints}")
    return list(value) if isinstance(default, list) else value


def _constraints(low: float | None, high: float | None, choices: Sequence[str]) -> str:
    """Describe the allowed values of a parameter; "" for any value."""
    if choices:
        return "one of " + ", ".join(choices)
    if low is not None and high is not None:
        return f"a number from {low:g} to {high:g}"
    if low is not None:
        return f"a number of at least {low:g}"
    return "" if high is None else f"a number of at most {high:g}"


def _fits(value: Any, low: float | None, high: float | None, choices: Sequence[str]) -> bool:
    if choices:
        return value in choices
    if isinstance(value, float) and not math.isfinite(value):
        return False
    return (low is None or value >= low) and (high is None or value <= high)
