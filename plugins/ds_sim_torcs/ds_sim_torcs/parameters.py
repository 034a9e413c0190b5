# SPDX-License-Identifier: Apache-2.0
"""All constants of the car and of the world of TORCS, in SI units.

Sources cited repeatedly below: *file*: `cars/155-DTM/155-DTM.xml` of TORCS 1.3.7; *simuv2*: its physics.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from ds_sim.parts import check_ranges
from ds_sim.simulator import AutopilotGains

CAR = "155-DTM"
"""Chosen: a saloon with four-wheel drive, whose first gear reaches 18 m/s; the small p406's ends at 9 m/s."""
SUBSTEPS = 25
"""Steps of TORCS in one of 1/20 s; simuv2: 2 ms."""
SETTLING = 500
"""Steps in which a new car comes to rest on its springs; chosen: 1 s, twice what it needs."""
PREVIEW_DISTANCE = 3.0
"""Distance of the autopilot's preview point, m; chosen with its gain."""
GAINS = AutopilotGains(proportional=0.5)
"""Chosen by driving random roads, for the largest distance from the edge of the lane."""


@dataclass(frozen=True, kw_only=True)
class TorcsParameters:
    """Parameters of the car: those of TORCS's file that are used outside it, and what replaces or controls others.

    Attributes:
        length: m; file.
        width: m; file.
        wheelbase: m; file: axles at 1.31 and -1.36.
        track: distance between the wheels of an axle, m; file: mean of 1.64 front and 1.66 rear, as simuv2 steers.
        mass: kg; file, without its 30 l of fuel, which simuv2 counts as 30 kg.
        fuel: kg; file.

        max_steering_angle: mean angle of the front wheels for |steering| = 1, rad; chosen: the rear axle's centre has a
            radius of 2.7 m, as of `bullet`; the file's 21 degrees are those of a racing car.
        road_friction: friction of the surface; chosen: with the file's racing tyres, of 1.6, it is 1.0, as of the other
            siblings (0.9 to 1.05); on TORCS's own asphalt, of 1.2, it would be 1.9.

        accelerator_share: accelerator at full throttle; chosen: 0 to 20 km/h in 3 to 4 s under the paper's equation 2,
            as of the other siblings; all of it would spin the wheels.
        brake_share: brake at no throttle; chosen: with the engine 0.2 g, as of the other siblings.
        neutral_throttle: throttle below which the car brakes above the fade speed, 0 to 1; chosen: a tenth, as the drag
            of TORCS's engine already slows the car where the others are neutral.
        fade_speed: speed below which that braking fades out, m/s; chosen: walking pace, 5 km/h, as of `bullet`.
        max_speed: speed at which the limiter sets in, m/s; paper 4.2.4: 30 km/h.
        limiter_band: speed range over which the limiter reduces the drive to zero, m/s; chosen: a tenth of the speed.
    """

    length: float = 4.8
    width: float = 1.9
    wheelbase: float = 2.67
    track: float = 1.65
    mass: float = 1100.0
    fuel: float = 30.0

    max_steering_angle: float = math.radians(45.0)
    road_friction: float = 1.0 / 1.6

    accelerator_share: float = 0.2
    brake_share: float = 0.05
    neutral_throttle: float = 0.1
    fade_speed: float = 5.0 / 3.6
    max_speed: float = 30.0 / 3.6
    limiter_band: float = 3.0 / 3.6

    def __post_init__(self) -> None:
        check_ranges(self, _LIMITS)

    def adjusted(self, *, friction: float, payload: float) -> TorcsParameters:
        """Copy as `ds_sim.parts.Vehicle.adjust` has it; springs and dampers stay those of the car."""
        if (friction, payload) == (1.0, 0.0):
            return self
        return dataclasses.replace(
            self,
            mass=self.mass + payload * (self.mass + self.fuel),
            road_friction=self.road_friction * friction,
        )

    @property
    def lock(self) -> float:
        """Angle of the inner front wheel for |steering| = 1, by which TORCS steers, rad."""
        return self.inner_angle(self.max_steering_angle)

    def inner_angle(self, mean: float) -> float:
        """Angle of the inner front wheel for a mean one, rad, left positive; simuv2 gives the outer one Ackermann's."""
        tangent = abs(math.tan(mean))
        return math.copysign(math.atan(tangent / (1.0 - 0.5 * self.track / self.wheelbase * tangent)), mean)

    def mean_angle(self, left: float, right: float) -> float:
        """Mean angle of two front wheels, rad, left positive: that of a wheel between them on the same circle."""
        left_tan, right_tan, half = math.tan(left), math.tan(right), 0.5 * self.track / self.wheelbase
        return math.atan(0.5 * (left_tan / (1.0 + half * left_tan) + right_tan / (1.0 - half * right_tan)))

    def pedals(self, throttle: float, speed: float) -> tuple[float, float]:
        """Accelerator and brake for a throttle, each 0 to 1.

        Args:
            throttle: 0 to 1.
            speed: m/s.
        """
        fade = min(max(speed / self.fade_speed, 0.0), 1.0)
        neutral = self.neutral_throttle * fade
        if throttle < neutral:
            return 0.0, self.brake_share * fade * (1.0 - throttle / neutral)
        limiter = min(max((self.max_speed + self.limiter_band - speed) / self.limiter_band, 0.0), 1.0)
        driven = (throttle - neutral) / (1.0 - neutral)
        return self.accelerator_share * driven * limiter, 0.0


_LIMITS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(
        ("length", "width", "wheelbase", "track", "mass", "limiter_band", "fade_speed"),
        (1e-6, math.inf),
    ),
    "max_steering_angle": (1e-6, math.radians(50.0)),
    "accelerator_share": (0.0, 1.0),
    "brake_share": (0.0, 1.0),
    "neutral_throttle": (1e-6, 0.9),
}
"""Range of each value whose range is not simply 0 or more."""
