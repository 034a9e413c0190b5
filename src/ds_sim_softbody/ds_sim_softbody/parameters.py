"""Constants of the soft-body car, each with its unit and its source."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class SoftbodyParameters:
    """A small front-driven car as nodes and beams.

    Attributes:
        substeps: physics steps per frame; 50 is 1 kHz, where springs of this stiffness are comfortably stable.
        body_rows: x of the lattice's rows before the middle, m; the second and the fourth carry the axles.
        body_half_width: y of the lattice's outer nodes, m.
        body_mass: of the lattice, kg.
        wheel_mass: of a wheel node with hub and half the suspension, kg.
        beam_stiffness, beam_damping: of the body's beams, N/m and N s/m.
        arm_stiffness, arm_damping: of the beams that hold a wheel: softer, as bushings are, N/m and N s/m.
        wheelbase: m.
        half_track: m.
        length, width: over all, m.
        max_steering_angle: of the mean front wheel at |steering| = 1, rad.
        steering_rate: of the front wheels, rad/s.
        tyre_radius: m.
        wheel_inertia: of a wheel with its share of the drive line, kg m^2.
        slip_stiffness: longitudinal force per slip and load, 1.
        cornering_stiffness: lateral force per rad of slip angle and load, 1/rad.
        friction: largest force per load, 1.
        relaxation: distance over which a slip builds up, m.
        rolling_resistance: force per load, 1.
        max_drive_force: of both driven wheels at full throttle, N.
        max_power: W.
        engine_braking: of both driven wheels with the throttle closed, N.
        drag_area: drag coefficient times frontal area, m^2.
        gravity_height: of the centre of mass, m.
        roll_frequency, pitch_frequency: of the body on its springs, Hz.
        body_damping_ratio: of roll and pitch, 1.
        roll_stiffness, pitch_stiffness: of the suspension, N m/rad.
        front_roll_share: share of the roll moment that the front axle carries, 1.
    """

    substeps: int = 50  # chosen: 20 fps x 50 = 1 kHz
    body_rows: tuple[float, ...] = (-1.85, -1.25, 0.0, 1.25, 1.85)  # chosen: bumpers, axles and middle
    body_half_width: float = 0.5  # chosen: the frame rails lie inside the wheels
    body_mass: float = 900.0  # chosen: with wheels 1,040 kg, a small hatchback with its driver
    wheel_mass: float = 35.0  # chosen: wheel, tyre, brake and hub of a small car
    beam_stiffness: float = 6.0e5  # chosen: bends visibly less than a wheel's bushings do
    beam_damping: float = 4.0e3  # chosen: settles within a few tens of milliseconds
    arm_stiffness: float = 4.0e5  # chosen: a wheel yields some millimetres under cornering force
    arm_damping: float = 4.0e3  # chosen: as the body's beams
    wheelbase: float = 2.5  # chosen: small hatchback (2.4 to 2.6 m)
    half_track: float = 0.725  # chosen: track 1.45 m of a small hatchback
    length: float = 3.9  # chosen: as above
    width: float = 1.68  # chosen: as above
    max_steering_angle: float = math.radians(37.0)  # chosen: turning circle of about 8 m, city cars have 8.5 to 10
    steering_rate: float = math.radians(55.0)  # chosen: a quick hand, 800 degrees/s at a ratio of 14.5
    tyre_radius: float = 0.29  # tyre 175/65 R14: 0.5 x 14 in + 0.65 x 175 mm = 0.29 m
    wheel_inertia: float = 1.0  # chosen: about m r^2 / 2 of wheel and tyre, plus drive shafts
    slip_stiffness: float = 18.0  # chosen: 10 to 30 for passenger tyres (Pacejka, Tire and Vehicle Dynamics)
    cornering_stiffness: float = 14.0  # chosen: 10 to 20 per rad for passenger tyres (the same)
    friction: float = 0.95  # dry asphalt: 0.8 to 1.0 (the same)
    relaxation: float = 0.25  # chosen: about a tyre radius (the same)
    rolling_resistance: float = 0.013  # passenger tyre on asphalt: 0.010 to 0.015
    max_drive_force: float = 3400.0  # chosen: 0 to 20 km/h in about 2.5 s under the throttle law
    max_power: float = 55.0e3  # chosen: small hatchback
    engine_braking: float = 2000.0  # chosen: low gear, lifts off to about 2 m/s^2
    drag_area: float = 0.65  # chosen: 0.32 x 2.05 m^2
    gravity_height: float = 0.52  # chosen: small hatchback
    roll_frequency: float = 1.8  # chosen: passenger cars roll at 1.5 to 2 Hz
    pitch_frequency: float = 1.6  # chosen: passenger cars pitch at 1.3 to 1.8 Hz
    body_damping_ratio: float = 0.35  # chosen: dampers of passenger cars, 0.2 to 0.4
    roll_stiffness: float = 48.0e3  # chosen: about 5.5 degrees of roll per g
    pitch_stiffness: float = 95.0e3  # chosen: about 2.9 degrees of pitch per g
    front_roll_share: float = 0.56  # chosen: stiffer in front, so that the car understeers at the limit

    @property
    def mass(self) -> float:
        """Of the whole car, kg."""
        return self.body_mass + 4 * self.wheel_mass
