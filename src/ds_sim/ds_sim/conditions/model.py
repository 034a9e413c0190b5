# SPDX-License-Identifier: Apache-2.0
"""The value `Conditions`: what a test fixes beside its road.

Names follow the taxonomy of the operational design domain in ISO 34503:2023 and BSI PAS 1883:2020: scenery (road
surface, lane markings), environment (weather, illumination) and dynamic elements (here the subject vehicle), to which
camera and sensor are added, which those standards leave to the system. Sources cited repeatedly below:

* *EN 1436*: Road markings, performance for road users (2018); *Koschmieder*: Beitr. Phys. freien Atm. 12 (1924);
* *CIE 146*: CIE equations for disability glare (2002); *Wong*: Theory of Ground Vehicles, 4th edition, 2008.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

from ds_base.errors import InputError

REFERENCE_ILLUMINANCE = 10_000.0
"""Illuminance of the road in every simulator's own picture, lx; chosen: an overcast day (CIE: 10 to 25 klx)."""


class ConditionsError(InputError):
    """Conditions that are unknown, out of range or contradictory; one line with what is allowed."""


class NotApplicableError(InputError):
    """A test with a condition that a simulator cannot realise: neither a failure of the driver nor an error."""


@dataclass(frozen=True, slots=True)
class Condition:
    """Description of one condition.

    Attributes:
        name: as in `Conditions` and on the command line.
        unit: SI unit; "" for a share or a factor.
        low: smallest value.
        high: largest value.
        stronger: which end of the range is harder for a driver; "both" for signed values and factors, "" for values
            that only say how or where another condition acts.
        kind: group of the standards' taxonomy.
        doc: what the value is, and why its range is what it is.
    """

    name: str
    unit: str
    low: float
    high: float
    stronger: str
    kind: str
    doc: str

    @property
    def allowed(self) -> str:
        """Allowed values, as error messages say them."""
        high, more = ("", " or more") if math.isinf(self.high) else (f" to {self.high:g}", "")
        return f"{self.low:g}{high}{f' {self.unit}' if self.unit else ''}{more}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """Operating conditions of one run; the defaults are each simulator's own world. SI units, None: as the simulator.

    `FIELDS` describes every value with its range and source.

    Raises:
        ConditionsError: a value is not a number, is out of range, or contradicts another one.
    """

    line_contrast: float = 1.0
    line_cover: float = 0.0
    line_cover_length: float = 2.0
    illuminance: float = REFERENCE_ILLUMINANCE
    veiling_luminance: float = 0.0
    low_sun: float = 0.0
    sun_azimuth: float | None = None
    sun_elevation: float | None = None
    shadow_density: float = 0.0
    shadow_depth: float = 0.7
    visibility: float = math.inf
    pavement_reflectance: float | None = None
    repair_share: float = 0.0
    camera_height: float = 1.0
    camera_pitch: float = 0.0
    camera_yaw: float = 0.0
    lens_dirt: float = 0.0
    sensor_noise: float = 0.0
    exposure: float = 1.0
    steering_lag: float = 0.0
    command_delay: float = 0.0
    friction: float = 1.0
    payload: float = 0.0
    tyre_pull: float = 0.0
    speed_limit: float | None = None

    def __post_init__(self) -> None:
        for condition in FIELDS.values():
            value = getattr(self, condition.name)
            if value is None and _default(condition.name) is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
                raise ConditionsError(f"{condition.name} is {value!r}, expected {condition.allowed}")
            if not condition.low <= value <= condition.high:
                raise ConditionsError(f"{condition.name} is {value:g}, expected {condition.allowed}")
            object.__setattr__(self, condition.name, float(value) + 0.0)  # one value for -0 and 0
        if self.shadow_depth != _default("shadow_depth") and not self.shadow_density:
            raise ConditionsError(f"shadow_depth is {self.shadow_depth:g} without shadows: give shadow_density too")
        if self.line_cover_length != _default("line_cover_length") and not self.line_cover:
            raise ConditionsError(
                f"line_cover_length is {self.line_cover_length:g} m without line_cover: give line_cover too"
            )

    @property
    def changed(self) -> dict[str, float]:
        """Values that differ from the defaults, all finite, by name in the order of the fields."""
        return {name: getattr(self, name) for name in FIELDS if getattr(self, name) != _default(name)}

    @property
    def is_default(self) -> bool:
        """True if these are each simulator's own conditions."""
        return self == DEFAULT

    def for_scene(self, realised: frozenset[str]) -> Conditions:
        """Return these conditions, or the default ones if none that a scene realises differs from them."""
        return self if realised & self.changed.keys() else DEFAULT


_ABOUT: dict[str, tuple[str, float, float, str, str, str]] = {
    "line_contrast": ("", 0.0, 1.0, "low", "lane markings",
        "luminance contrast of the paint against the pavement that is left, over that of new paint; EN 1436 ranks "
        "markings by luminance coefficient Qd: Q2, 100 mcd/m2/lx, is 0.26 here on asphalt of reflectance 0.12"),
    "line_cover": ("", 0.0, 1.0, "high", "lane markings",
        "share of the length of each line on which no paint shows: worn off, sanded over"),
    "line_cover_length": ("m", 0.5, 20.0, "", "lane markings",
        "length of one bare piece of line; chosen: from a tyre's skid to a construction site"),
    "illuminance": ("lx", 1.0, REFERENCE_ILLUMINANCE, "low", "illumination",
        "illuminance of the road; the camera's automatic exposure makes up for a factor of 16, at the cost of noise; "
        "CIE: 1 to 10 lx are street lighting, 400 lx sunset, 10,000 lx an overcast noon"),
    "veiling_luminance": ("cd/m2", 0.0, 3000.0, "high", "illumination",
        "luminance of stray light over the whole picture (CIE 146), to which the automatic exposure adapts; a white "
        "wall at 10,000 lx has 3,183"),
    "low_sun": ("lx", 0.0, 20_000.0, "high", "illumination",
        "illuminance at the lens by a sun (indoors: a lamp) in the direction of sun_azimuth and sun_elevation, whose "
        "veil falls as 10 E / angle^2 (Stiles-Holladay, CIE 146); chosen: up to a clear sun 10 degrees high"),
    "sun_azimuth": ("rad", -math.pi, math.pi, "", "illumination",
        "direction of the sun, counter-clockwise from +x of the road frame"),
    "sun_elevation": ("rad", 0.02, 1.5, "", "illumination",
        "elevation of the sun above the horizon"),
    "shadow_density": ("", 0.0, 0.9, "high", "illumination",
        "share of the road's length that lies in shadows across it; all of it would be no pattern any more"),
    "shadow_depth": ("", 0.0, 0.95, "high", "illumination",
        "share of the light that a shadow takes; the blue sky alone gives 10 to 30% of the light of sun and sky"),
    "visibility": ("m", 20.0, math.inf, "low", "weather",
        "meteorological visibility: contrast falls as exp(-3.912 distance / visibility) (Koschmieder, 2% threshold); "
        "WMO: fog is below 1,000 m, dense fog below 50 m"),
    "pavement_reflectance": ("", 0.04, 0.5, "high", "road surface",
        "mean diffuse reflectance of the pavement; new asphalt has 0.05, worn asphalt 0.12 to 0.18, new concrete 0.35 "
        "to 0.40 (American Concrete Pavement Association, albedo)"),
    "repair_share": ("", 0.0, 0.6, "high", "road surface",
        "share of the road's area under rectangular repair patches of new, darker asphalt; lines are repainted on "
        "them"),
    "camera_height": ("", 0.5, 2.0, "both", "camera",
        "factor on the camera's height; chosen: from a sports car to a lorry"),
    "camera_pitch": ("rad", -0.15, 0.15, "both", "camera",
        "added to the camera's pitch, nose down positive; chosen: up to twice what a hard-braking, loaded car has"),
    "camera_yaw": ("rad", -0.15, 0.15, "both", "camera",
        "angle of the camera about the car's vertical axis, left positive"),
    "lens_dirt": ("", 0.0, 0.5, "high", "camera",
        "share of the picture behind smudges on the lens, which keep their place"),
    "sensor_noise": ("grey levels", 0.0, 40.0, "high", "camera",
        "standard deviation of noise added to the delivered image"),
    "exposure": ("", 0.125, 8.0, "both", "camera",
        "factor on the light that the sensor collects: three stops either way"),
    "steering_lag": ("s", 0.0, 1.0, "high", "vehicle",
        "time constant of a first-order lag of the steering; chosen: from a steering robot to a slack, heavy steering"),
    "command_delay": ("s", 0.0, 1.0, "high", "vehicle",
        "dead time from a command to the vehicle; chosen: up to what makes driving over mobile networks impossible"),
    "friction": ("", 0.1, 1.0, "low", "road surface",
        "factor on the tyres' grip on this simulator's dry road; wet asphalt has 0.6 to 0.8 of it, hard snow "
        "0.24, ice 0.12 (Wong, table 1.3)"),
    "payload": ("", 0.0, 0.5, "high", "vehicle",
        "load over the mass of the car, spread like that mass; small cars carry 0.3 to 0.4 of it"),
    "tyre_pull": ("rad", -0.05, 0.05, "both", "vehicle",
        "angle of the front wheels that has the same effect as a pull to one side, left positive; chosen: from worn "
        "tyres to a bent track rod"),
    "speed_limit": ("m/s", 3.0, 30.0 / 3.6, "", "vehicle",
        "speed at which the throttle is cut off; below 3 m/s a road takes longer than the time limit of a run"),
}  # fmt: skip
"""Condition -> the attributes of its `Condition`."""
FIELDS = {field.name: Condition(field.name, *_ABOUT[field.name]) for field in fields(Conditions)}
"""Every condition by name, in the order of `Conditions`."""


@cache
def _default(name: str) -> float | None:
    default: Any = next(f.default for f in fields(Conditions) if f.name == name)
    return None if default is None else float(default)


DEFAULT = Conditions()
"""Each simulator's own conditions."""
_LOG = frozenset({"illuminance", "exposure", "camera_height", "friction", "line_cover_length"})
"""Ratios count: light is measured in stops, mountings and lengths as factors, and the sources of `friction` rank
surfaces from ice (0.12) over snow (0.24) to wet asphalt (0.6) by factors of two."""


def _transforms(name: str) -> tuple[Callable[[float], float], Callable[[float], float]]:
    """From a value of a condition to its scale, and back.

    Logarithmic for ratios; reciprocal for visibility, whose inverse is the extinction of the air (Koschmieder), 0 where
    it is clear; linear for all others, most of which may be 0.
    """
    if name == "visibility":
        return lambda value: 1.0 / value, lambda value: 1.0 / value if value > 0.0 else math.inf
    return (math.log, math.exp) if name in _LOG else (float, float)


def between(name: str, start: float, end: float, share: float) -> float:
    """Value of a condition at a share, 0 to 1, of the way from one value to another; both ends are exact."""
    if share in (0.0, 1.0):
        return end if share else start
    there, back = _transforms(name)
    value = back(there(start) + share * (there(end) - there(start)))
    low, high = min(start, end), max(start, end)
    return min(max(value, low), high)


def share_of(name: str, start: float, end: float, value: float) -> float:
    """Return the share of the way at which a value lies, in [0, 1]; the inverse of `between`."""
    there, _ = _transforms(name)
    return min(max((there(value) - there(start)) / (there(end) - there(start)), 0.0), 1.0)
