# SPDX-License-Identifier: Apache-2.0
"""All constants of the 1:16 car, in SI units of the model car; many can be fitted to recorded drives.

Sources cited repeatedly below:

* *chassis*: nominal values of the chassis class of the Donkey Car guide (HSP 94186, Exceed Magnet: 1:16,
  shaft-driven four-wheel drive, brushed motor). Nominal, not measured on one car.
* *template*: the configuration that Donkey Car's `createcar` generates for that chassis.
* *F1TENTH*: the default parameters of the F1TENTH simulator for a 1:10 car with the same kind of tyre.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from ds_sim.parts import check_ranges

SCALE = 16.0
"""Road metres per model metre: a 1:16 car on a 1:16 road. Time is not scaled."""
GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True, kw_only=True)
class DonkeyParameters:
    """Parameters of the car, its tyres, steering servo and motor; lengths in model metres."""

    wheelbase: float = 0.174  # m; chassis (0.174), 2.78 road metres
    track: float = 0.135  # distance between the wheels of an axle, m; chassis (0.13 to 0.14)
    mass: float = 1.4  # mass of the whole car, kg; chosen: chassis 0.9; computer, power bank, plate and cage 0.5
    # Share of the static load on the front axle, 0 to 1; chosen: battery and plate are in the middle.
    front_share: float = 0.5
    yaw_inertia: float = 0.0129  # kg m^2; a uniform box of 0.28 x 0.18 m with this mass
    # m; F1TENTH has 0.074 at 1:10, 0.046 at 1:16; chosen 0.05 for the plate and the cage.
    centre_of_mass_height: float = 0.05
    # Inertia about the roll axis on the ground, kg m^2; box of 0.18 x 0.10 m at that height.
    roll_inertia: float = 0.0084
    # Inertia about the pitch axis on the ground, kg m^2; box of 0.28 x 0.10 m at that height.
    pitch_inertia: float = 0.0138
    roll_frequency: float = 5.0  # undamped natural frequency, Hz; chosen: short stiff springs under a small car
    pitch_frequency: float = 5.0  # undamped natural frequency, Hz; chosen as above
    body_damping: float = 0.35  # damping ratio of the roll and pitch modes; chosen: oil dampers of the chassis
    roll_front_share: float = 0.5  # share of the roll stiffness on the front axle, 0 to 1; chosen: equal springs

    # Peak tyre force over load; chosen: rubber on a smooth floor has 0.8 to 0.9 (F1TENTH 1.05 on asphalt).
    friction: float = 0.85
    # Shape factor C of the Magic Formula for lateral force; Pacejka, Tire and Vehicle Dynamics, ch. 4: 1.3.
    shape: float = 1.3
    front_stiffness: float = 4.95  # slip stiffness over load, 1/rad; F1TENTH, 1.0489 x 4.718
    rear_stiffness: float = 5.72  # slip stiffness over load, 1/rad; F1TENTH, 1.0489 x 5.4562
    # Relative loss of friction per relative increase of load; chosen: low end of road tyres (0.05 to 0.2).
    load_sensitivity: float = 0.05
    # m; Pacejka ch. 7: of the order of the wheel's radius (0.0315), less for a stiff carcass.
    relaxation_length: float = 0.02
    # Time constant of the carcass as a spring with a damper, s; chosen: oscillations then decay in about two cycles, as
    # in rubber.
    carcass_damping: float = 0.012
    # Force over load of tyres and gears with the motor off; chosen: a deceleration of 2.4 road m/s^2, the upper end of
    # tyres on a hard floor (0.01 to 0.015).
    rolling_resistance: float = 0.015
    # Share of the exact Ackermann geometry, 0 parallel to 1 exact; chosen: typical linkage of the chassis.
    ackermann: float = 0.6

    # Mean angle of the front wheels for |steering| = 1, rad; 35 degrees: the stock linkage gives 25 to 30 and a longer
    # servo horn 35 to 38 (template's own model: 45).
    max_steering_angle: float = math.radians(35.0)
    # Angle of the wheels with the servo centred, rad, left positive; 0: trimmed with `calibrate`.
    steering_trim: float = 0.0
    steering_pulse_steps: int = 85  # pulse counts from centre to lock; template, (460 - 290) / 2
    # Largest rate of the wheels, rad/s; Hitec HS-311 data sheet: 60 degrees of the horn in 0.15 to 0.19 s without load
    # (5.5 to 7 rad/s), times a linkage ratio of about 0.8.
    servo_rate: float = 4.8
    # Time constant of the servo's position loop, s; chosen: one and a half pulse periods at 60 Hz.
    servo_lag: float = 0.025
    # Total play of gears, servo saver and linkage at the wheels, rad; chosen: 1 degree.
    servo_backlash: float = math.radians(1.0)
    # Delay from command to pulse, s; chosen: half a 50 ms drive loop and one 16.7 ms pulse period.
    command_delay: float = 0.042

    throttle_pulse_steps: int = 130  # pulse counts from stop to full; template, 500 - 370
    # Throttle below which the speed controller outputs nothing; chosen: a neutral range of 6%, as car controllers have,
    # with the stop pulse calibrated towards its edge (template's MIN_THROTTLE: 0.1). With a wider one, a car that stops
    # with steering near 1 would not start again.
    throttle_dead_band: float = 0.04
    # Duty just above the dead band; chosen: the car then runs at the template's MIN_SPEED, 0.1 m/s.
    start_duty: float = 0.0325
    # Duty at throttle 1; chosen: calibrated so that full throttle suits a 30 km/h road at 1:16.
    full_duty: float = 0.19
    free_speed: float = 8.0  # speed of the car at duty 1 without friction, m/s; chassis (25 to 30 km/h)
    # Force at the tyres at duty 1 and standstill, N; chosen: 380-size motor, 0.07 N m, geared 6.6 to 1, wheels of 31.5
    # mm (template's WHEEL_RADIUS), efficiency 0.7.
    stall_force: float = 10.3
    # Braking while the throttle is in the dead band, as a share of that of the shorted motor; chosen: the lowest
    # setting of speed controllers, 5 to 10%.
    drag_brake: float = 0.05
    motor_lag: float = 0.12  # time constant from pulse to motor voltage, s; chosen: the speed controller's soft start
    # Inertia of wheels, gears and rotor as equivalent mass at the tyres, kg; a 380-size rotor of 18 g cm^2 geared as
    # above (0.08) and four wheels of 35 g (0.07).
    rotating_mass: float = 0.15
    # Share of the drive force on the front axle, 0 to 1; chassis: shaft drive, equal differentials.
    drive_front_share: float = 0.5

    def __post_init__(self) -> None:
        check_ranges(self, _LIMITS)

    def adjusted(self, *, friction: float, payload: float) -> DonkeyParameters:
        """Copy as `ds_sim.parts.Vehicle.adjust` has it; springs and dampers stay those of the car."""
        grown = 1.0 + payload
        softer = 1.0 / math.sqrt(grown)
        # The lean of the heavier body is taken up by the springs, which the frequency does not show.
        return dataclasses.replace(
            self,
            mass=self.mass * grown,
            yaw_inertia=self.yaw_inertia * grown,
            roll_inertia=self.roll_inertia * grown,
            pitch_inertia=self.pitch_inertia * grown,
            roll_frequency=self.roll_frequency * softer,
            pitch_frequency=self.pitch_frequency * softer,
            body_damping=self.body_damping * softer,
            # The reference load of this grows with the mass.
            friction=self.friction * friction * (1.0 - self.load_sensitivity * payload),
        )

    def changed(self, **values: float) -> DonkeyParameters:
        """Copy with some values changed; ValueError if one does not exist or is out of range."""
        names = {field.name for field in dataclasses.fields(self)}
        for name in values:
            if name not in names:
                raise ValueError(f"{name} is not a parameter of the car: expected one of {', '.join(sorted(names))}")
        return dataclasses.replace(self, **values)  # type: ignore[arg-type]


_TINY = 1e-6
_LIMITS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(
        (
            "wheelbase", "track", "mass", "yaw_inertia", "roll_inertia", "pitch_inertia", "roll_frequency",
            "pitch_frequency", "front_stiffness", "rear_stiffness", "relaxation_length", "servo_rate",
            "servo_lag", "free_speed", "stall_force", "motor_lag", "friction",
        ),
        (_TINY, math.inf),
    ),
    **dict.fromkeys(
        ("front_share", "roll_front_share", "ackermann", "drive_front_share", "drag_brake"), (0.0, 1.0)
    ),
    **dict.fromkeys(("throttle_dead_band", "start_duty", "full_duty"), (0.0, 0.99)),
    **dict.fromkeys(("steering_pulse_steps", "throttle_pulse_steps"), (1.0, 2048.0)),
    "shape": (1.0, 2.0),
    "max_steering_angle": (_TINY, 1.2),
    "steering_trim": (-0.3, 0.3),
}  # fmt: skip
"""Range of each value whose range is not simply 0 or more."""
