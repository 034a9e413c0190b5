# SPDX-License-Identifier: Apache-2.0
"""Conditions as `line_contrast=0.4,visibility=40`, as JSON objects of the changed values, and in words for people."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Literal

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
    """Make conditions of names and values, as messages carry them, each at most once; what is not named is default."""
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
    """Check the name of a condition; the ConditionsError has those that are meant, or all."""
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


Side = Literal["", "or more", "or less"]
"""Which values beside the one that is named are meant."""

PHRASES: Mapping[str, str] = {
    "line_contrast": "where lines keep {share} of new paint's contrast",
    "line_cover": "where {share} of the line paint is missing",
    "line_cover_length": "where paint is missing for {value} at a time",
    "illuminance": "in light of {value}",
    "veiling_luminance": "in stray light of {value}",
    "low_sun": "against a low sun of {value}",
    "sun_azimuth": "with the sun {degrees} to the left of the road frame's x",
    "sun_elevation": "with the sun {degrees} above the horizon",
    "shadow_density": "where shadows lie on {share} of the road",
    "shadow_depth": "in shadows that take {share} of the light",
    "visibility": "in fog or haze with a visibility of {value}",
    "pavement_reflectance": "on pavement that reflects {share} of the light",
    "repair_share": "where repair patches cover {share} of the road",
    "camera_height": "with the camera at {share} of its height",
    "camera_pitch": "with the camera tilted {degrees} down",
    "camera_yaw": "with the camera turned {degrees} to the left",
    "lens_dirt": "with dirt on {share} of the lens",
    "sensor_noise": "with camera noise of {value}",
    "exposure": "with {share} of the usual exposure",
    "steering_lag": "with steering that lags by {value}",
    "command_delay": "with commands that arrive {value} late",
    "friction": "on a road with {share} of the dry road's grip",
    "payload": "with a load of {share} of the car's mass",
    "tyre_pull": "with a pull to the left worth {degrees} of steering",
    "speed_limit": "with a speed limit of {value}",
}
"""Condition -> phrase; `{share}` is a fraction or percentage, `{degrees}` an angle, `{value}` a number with a unit."""
_TURNED = {" down": " up", " to the left": " to the right"}
"""Word for a positive angle -> for a negative one."""
_OPPOSITE: Mapping[Side, Side] = {"": "", "or more": "or less", "or less": "or more"}
_FRACTIONS = {
    0.1: "a tenth",
    0.2: "a fifth",
    0.25: "a quarter",
    1 / 3: "a third",
    0.5: "half",
    2 / 3: "two thirds",
    0.75: "three quarters",
}
_NEAR = 0.015
"""Distance from a fraction at which it names a share; the code name beside it carries the digits."""


def conditions_in_words(name: str, low: float, high: float | None = None, side: Side = "") -> str:
    """Say a value of a condition, or a range of values, as a driver would, with the code name in brackets.

    The side says which values beside a single one are meant.

    Examples:
        >>> conditions_in_words("line_cover", 0.259, side="or more")
        'where a quarter or more of the line paint is missing (line_cover 0.259)'
        >>> conditions_in_words("camera_pitch", -0.093, side="or less")
        'with the camera tilted 5.3 degrees or more up (camera_pitch -0.093 rad)'
        >>> conditions_in_words("visibility", 40.0, 50.0)
        'in fog or haze with a visibility of 40 to 50 m (visibility)'
    """
    phrase, unit = PHRASES[name], f" {FIELDS[name].unit}".rstrip()
    ends = [low] if high is None or high == low else [low, high]
    value = " to ".join(map(format_3sf, ends)) + unit
    if "{value}" in phrase:
        return f"{phrase.format(value=f'{value} {side}'.rstrip())} ({name})"
    if "{share}" in phrase:
        share = " to ".join(f"{100.0 * end:.0f}" for end in ends) + "%"
        fraction = min(_FRACTIONS, key=lambda one: abs(one - low))
        if len(ends) == 1 and abs(fraction - low) <= _NEAR:
            share = _FRACTIONS[fraction]
        return f"{phrase.format(share=f'{share} {side}'.rstrip())} ({name} {value})"
    if max(ends) < 0.0:
        ends, side = [-end for end in reversed(ends)], _OPPOSITE[side]
        for word, other in _TURNED.items():
            phrase = phrase.replace(word, other)
    degrees = " to ".join(f"{math.degrees(end):.1f}" for end in ends) + " degrees"
    return f"{phrase.format(degrees=f'{degrees} {side}'.rstrip())} ({name} {value})"
