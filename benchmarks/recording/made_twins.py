# SPDX-License-Identifier: Apache-2.0
"""Cars that no simulator here is: the 1:16 car with other parameters and another camera pose, from a seeded generator.

Each range and its source were fixed before the first drive. Two kinds: `near` cars are of one kind as a hand builds it,
and every fourth has one value far outside of its range, in turns of `OUTSIDE`: cars that the simulators may not span.
Many of them fail on the same tests. `wide` cars differ in everything at once, over the ranges `WIDE`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from ds_sim.conditions.model import Conditions
from ds_twin_donkey.parameter_file import FORMAT
from ds_twin_donkey.parameters import DonkeyParameters

Range = tuple[float, float]
Kind = Literal["near", "wide"]

WITHIN: Mapping[str, Range] = {
    "max_steering_angle": (math.radians(30.0), math.radians(38.0)),
    "servo_rate": (4.4, 5.6),
    "servo_lag": (1 / 60, 2 / 60),
    "command_delay": (1 / 60, 0.05 + 1 / 60),
    "mass": (1.2, 1.7),
    "friction": (0.8, 1.05),
    "camera_height": (0.9, 1.1),
    "camera_pitch": (-0.035, 0.035),
    "camera_yaw": (-0.0175, 0.0175),
}
"""Ranges of what a car of the same kind may have, uniform. Sources, beyond those of `DonkeyParameters`: lock from the
stock linkage's upper end to a longer horn; rate of the Hitec HS-311's horn (5.5 to 7 rad/s) times the linkage's 0.8;
lag of one to two pulse periods at 60 Hz; delay from one pulse period to a whole 50 ms loop and one; the chassis (0.9
kg) with 0.3 to 0.8 kg of computer and battery; rubber on a smooth floor (0.8) to asphalt (F1TENTH, 1.05). Camera
chosen: as well as a hand mounts it, a tenth of its height, 2 degrees of pitch, 1 degree of yaw."""
OUTSIDE: Mapping[str, Range] = {
    "max_steering_angle": (math.radians(18.0), math.radians(23.0)),
    "command_delay": (0.15, 0.25),
    "camera_pitch": (0.08, 0.12),
    "friction": (0.3, 0.45),
    "camera_yaw": (0.06, 0.1),
}
"""Ranges of the one value that makes an outside twin: a linkage that binds (stock: 25 to 30 degrees), a network
that drives over Wi-Fi, a camera that slipped down by 5 to 7 degrees or aside by 3 to 6, dust on the floor (half of the
smooth floor's grip). Chosen: two to five widths of the range within beyond its middle."""
WIDE: Mapping[str, Range] = {
    "max_steering_angle": (math.radians(20.0), math.radians(40.0)),
    "servo_rate": (2.4, 7.0),
    "servo_lag": (1 / 60, 0.1),
    "command_delay": (1 / 60, 0.2),
    "mass": (1.0, 2.4),
    "friction": (0.4, 1.05),
    "steering_trim": (-0.05, 0.05),
    "camera_height": (0.75, 1.25),
    "camera_pitch": (-0.1, 0.1),
    "camera_yaw": (-0.08, 0.08),
}
"""Ranges of cars that are unlike each other, uniform. Chosen: from about the middle of each range in `OUTSIDE` to the
good end of the one in `WITHIN`, on both sides where it has two; servos from half the rate of a cheap one to a fast
one's; a bare chassis to one with a lidar on top; trim of 3 degrees, as `Conditions.tyre_pull`; a mast a quarter
shorter or taller."""
EVERY = 4
"""Every fourth twin is outside; chosen: "several" of 20."""
CAMERA = ("camera_height", "camera_pitch", "camera_yaw")


@dataclass(frozen=True, kw_only=True)
class MadeTwin:
    """A car of the generator.

    Attributes:
        kind: `near` or `wide`.
        number: from 1.
        values: parameters of the car and pose of its camera, as named in `WITHIN` or `WIDE`.
        outside: the value that is far outside, or "".
    """

    kind: Kind
    number: int
    values: Mapping[str, float]
    outside: str

    @property
    def name(self) -> str:
        """Name in tables and of the parameter file."""
        parts = ("car" if self.kind == "near" else self.kind, f"{self.number:02d}", self.outside)
        return "-".join(part for part in parts if part)

    @property
    def conditions(self) -> Conditions:
        """Camera pose, under which every test of this twin is driven."""
        return Conditions(**{key: self.values[key] for key in CAMERA})

    @property
    def parameters(self) -> DonkeyParameters:
        """Parameters of the car; its inertia grows with the mass, as that of a uniform box."""
        nominal = DonkeyParameters()
        grown = self.values["mass"] / nominal.mass
        inertia = {key: getattr(nominal, key) * grown for key in ("yaw_inertia", "roll_inertia", "pitch_inertia")}
        return nominal.changed(**{key: v for key, v in self.values.items() if key not in CAMERA}, **inertia)

    def simulator(self, folder: Path) -> str:
        """Write the parameter file unless it is there; returns the simulator's name, `donkey@FILE`."""
        path = folder / f"{self.name}.yaml"
        parameters = {f.name: {"value": getattr(self.parameters, f.name)} for f in dataclasses.fields(DonkeyParameters)}
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            path.write_text(yaml.safe_dump({"format": FORMAT, "parameters": parameters}, sort_keys=False))
        return f"donkey@{path}"

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {"name": self.name, "outside": self.outside, "values": dict(self.values)}


def made_twin(number: int, seed: int, kind: Kind = "near") -> MadeTwin:
    """Make a twin; the same one however many others are made.

    Args:
        number: from 1.
        seed: seed of the generator.
        kind: which ranges.
    """
    if kind == "wide":
        rng = np.random.default_rng([seed, 1, number])
        values = {key: float(rng.uniform(*of)) for key, of in WIDE.items()}
        return MadeTwin(kind=kind, number=number, values=values, outside="")
    rng = np.random.default_rng([seed, number])
    values = {key: float(rng.uniform(*of)) for key, of in WITHIN.items()}
    outside = ""
    if number % EVERY == 0:
        outside = list(OUTSIDE)[(number // EVERY - 1) % len(OUTSIDE)]
        values[outside] = float(rng.uniform(*OUTSIDE[outside]))
    return MadeTwin(kind=kind, number=number, values=values, outside=outside)
