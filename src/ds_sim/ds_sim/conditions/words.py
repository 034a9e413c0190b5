# SPDX-License-Identifier: Apache-2.0
"""Conditions in the words of a driver: `in fog or haze with a visibility of 80 m or less (visibility)`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from ds_sim.conditions.model import FIELDS
from ds_sim.conditions.text import format_3sf

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
