# SPDX-License-Identifier: Apache-2.0
"""Reads and writes conditions as `line_contrast=0.4,visibility=40` and as JSON objects of the changed values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from difflib import get_close_matches

from ds_sim.conditions.model import FIELDS, Conditions, ConditionsError

_UNITS = {"deg": ("rad", math.pi / 180.0), "km/h": ("m/s", 1.0 / 3.6)}
"""Further units that a value may carry -> SI unit, factor."""
_COLLOQUIAL = {
    "visibility": "fog foggy mist haze smoke rain snow", "friction": "rain wet snow ice icy slippery grip mu",
    "illuminance": "dark darkness dim dusk night brightness light lux", "low_sun": "sun sunlight glare backlight",
    "veiling_luminance": "glare veil flare stray_light", "shadow_density": "shadow shadows shade",
    "command_delay": "delay latency dead_time lag network_delay", "steering_lag": "lag steering_delay",
    "lens_dirt": "dirt dirty dust mud drops smudge", "sensor_noise": "noise grain", "repair_share": "patches repairs",
    "line_contrast": "contrast lines markings paint faded worn", "line_cover": "occlusion missing_lines covered worn",
    "pavement_reflectance": "pavement asphalt concrete albedo reflectance", "camera_height": "height mount",
    "camera_pitch": "pitch tilt", "camera_yaw": "yaw pan", "exposure": "overexposure underexposure gain",
    "payload": "load mass weight passengers", "tyre_pull": "pull tire_pull wind drift", "speed_limit": "speed velocity",
}  # fmt: skip
"""Condition -> what people type for it; chosen."""
MAX_TEXT = 4096
"""Characters of a text that is read; chosen: all conditions with full precision take a quarter of that."""


def parse_conditions(text: str) -> Conditions:
    """Read `name=value,name=value`; "" is the default.

    A value is a number in the condition's SI unit; angles may be given as `4deg`, speeds as `20km/h`.

    Raises:
        ConditionsError: anything else, or conditions that cannot be.

    Examples:
        >>> from ds_sim import parse_conditions
        >>> conditions = parse_conditions("visibility=60, camera_pitch=2deg")
        >>> conditions.visibility, round(conditions.camera_pitch, 4)
        (60.0, 0.0349)
    """
    if len(text) > MAX_TEXT:
        raise ConditionsError(f"conditions of {len(text)} characters, expected at most {MAX_TEXT}")
    values: dict[str, float] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (word.strip() for word in part.partition("="))
        check_known(name)
        if not equals or not value:
            raise ConditionsError(f"{name} has no value, expected {name}=NUMBER: {FIELDS[name].allowed}")
        _check_new(name, values)
        values[name] = _number(name, value)
    return Conditions(**values)


def format_conditions(conditions: Conditions) -> str:
    """Write conditions as `parse_conditions` reads them, bit for bit; "" for the default.

    Examples:
        >>> from ds_sim import Conditions, format_conditions
        >>> format_conditions(Conditions(visibility=60.0, line_contrast=0.4))
        'line_contrast=0.4,visibility=60'
    """
    return ",".join(f"{name}={_plain(value)}" for name, value in conditions.changed.items())


def from_json(document: object) -> Conditions:
    """Read a mapping from names to numbers, as JSON and YAML give it; it holds what differs from the default."""
    if not isinstance(document, Mapping):
        raise ConditionsError(f"conditions are a {type(document).__name__}, expected names and numbers")
    for name in document:
        check_known(name)
    return Conditions(**document)


def from_pairs(pairs: Iterable[tuple[str, float]]) -> Conditions:
    """Make conditions of names and values, as messages carry them; what is not named has its default.

    Raises:
        ConditionsError: a name is unknown or given twice, or conditions that cannot be.
    """
    values: dict[str, float] = {}
    for name, value in pairs:
        check_known(name)
        _check_new(name, values)
        values[name] = value
    return Conditions(**values)


def format_3sf(value: float) -> str:
    """Format a value for people: three significant digits, without an exponent."""
    import numpy as np  # reading conditions, at the start of every verb that takes them, needs no NumPy

    return np.format_float_positional(value, precision=3, fractional=False, trim="-")


def _plain(value: float) -> str:
    return repr(int(value)) if value.is_integer() else repr(value)


def _number(name: str, text: str) -> float:
    condition, factor, number = FIELDS[name], 1.0, text
    for unit, (si, scale) in _UNITS.items():
        if text.endswith(unit) and condition.unit == si:
            factor, number = scale, text.removesuffix(unit)
    try:
        return float(number) * factor
    except ValueError:
        raise ConditionsError(f"{name} is {text[:40]!r}, expected {condition.allowed}") from None


def _check_new(name: str, values: Mapping[str, float]) -> None:
    if name in values:
        raise ConditionsError(f"{name} is given twice: give it once")


def check_known(name: object) -> None:
    """Check the name of a condition.

    Raises:
        ConditionsError: there is none of this name; one line with those that are meant, or with all.
    """
    if name in FIELDS:
        return
    typed = str(name)[:40]
    word = typed.lower().replace("-", "_").replace(" ", "_")
    meant = [field for field, words in _COLLOQUIAL.items() if word in words.split()]
    meant = (
        meant or get_close_matches(word, FIELDS, 1) or [field for field in FIELDS if len(word) > 3 and word in field]
    )
    if not meant:
        raise ConditionsError(f"unknown condition {typed!r}: expected some of {', '.join(FIELDS)}")
    ranges = " or ".join(f"{field} ({FIELDS[field].allowed})" for field in meant)
    raise ConditionsError(f"unknown condition {typed!r}: did you mean {ranges}?")
