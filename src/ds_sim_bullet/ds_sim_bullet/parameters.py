# SPDX-License-Identifier: Apache-2.0
"""All constants of the rigid-body car and of the engine that integrates it, in SI units.

Sources cited repeatedly below:

* *sheet*: published data of the Renault Twingo Electric (2021), a small rear-wheel-drive city car; steering, balance,
  track and tyres are those published for the Twingo III of 2014, which shares its platform.
* *Gillespie*: Fundamentals of Vehicle Dynamics, SAE 1992.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True, kw_only=True)
class BulletParameters:
    """Parameters of the car, its suspension, steering, tyres and motor, and settings of the engine."""

    length: float = 3.615  # m; sheet
    width: float = 1.646  # m; sheet
    height: float = 1.541  # m; sheet
    wheelbase: float = 2.492  # m; sheet
    track: float = 1.44  # distance between the wheels of an axle, m; sheet: mean of 1.452 front and 1.425 rear
    mass: float = 1208.0  # kg; sheet: kerb weight, which includes the driver by the European definition
    unsprung_mass: float = 35.0  # unsprung mass of one corner, kg; Gillespie ch. 5: 13 to 15% of the sprung mass.
    wheel_mass: float = 15.0  # mass of one wheel with tyre, part of the unsprung mass, kg; chosen: steel 15-inch wheel
    front_share: float = 0.45  # share of the static load on the front axle, 0 to 1; sheet (rear motor): 45 to 55
    # Height of the sprung mass's centre, m; chosen: 0.36 of the car's height (Gillespie: 0.35 to 0.4), because the
    # battery is under the floor.
    centre_of_mass_height: float = 0.55
    ground_clearance: float = 0.13  # clearance under the body, m; chosen: typical of the class, 0.12 to 0.15

    # Natural frequency of the body on its springs, Hz; Gillespie ch. 5: 1 to 1.5, the stiffer end for a light car.
    ride_frequency: float = 1.4
    damping_ratio: float = 0.3  # damping ratio of that mode; Gillespie ch. 5: 0.2 to 0.4.
    # Force of the front bar per difference of travel, N/m; chosen: together with the rear bar it gives 5.7 degrees of
    # roll per g, within the 5 to 7 of small cars (Gillespie ch. 6).
    front_anti_roll: float = 7000.0
    # The same at the rear, N/m; chosen: softer than at the front, as the rear carries more load.
    rear_anti_roll: float = 3000.0
    # Suspension travel up and down to the bump stops, m; chosen: 0.07, of the class's 0.06 to 0.08.
    travel: float = 0.07
    stop_stiffness: float = 160e3  # stiffness of the rubber bump stops, N/m; chosen: eight times the springs

    wheel_radius: float = 0.30  # m; sheet: 165/65 R15 (0.298) in front and 185/60 R15 (0.301) at the rear
    # Inertia of a wheel about its axle, kg m^2; chosen: a 15 kg wheel with 0.75 of its mass at the rim.
    wheel_spin_inertia: float = 0.9
    # Inertia of the motor at one rear wheel, kg m^2; chosen: 0.02 kg m^2 geared 9 to 1, halved.
    rotor_inertia: float = 0.8
    # Friction coefficient of a tyre on dry asphalt; Gillespie ch. 10: 0.8 to 0.9, sliding to peak.
    friction: float = 0.9
    rolling_resistance: float = 0.013  # force over load; Gillespie ch. 4: 0.012 to 0.015 for radial tyres on asphalt.

    # Mean angle of the front wheels for |steering| = 1, rad; sheet: a turning circle of 8.6 m from kerb to kerb gives
    # the rear axle's centre a radius of 2.79 m.
    max_steering_angle: float = math.radians(41.8)
    # Largest rate of the mean angle, rad/s; chosen: 60 degrees/s, a quick electric power steering (900 degrees/s at a
    # steering wheel geared 15 to 1).
    steering_rate: float = math.radians(60.0)
    steering_torque: float = 2000.0  # largest torque about one kingpin, N m; chosen: more than the tyres can resist

    # Force at the tyres at full throttle, N; chosen: 0 to 20 km/h in 3 to 4 s under the paper's equation 2, an economy
    # map of a motor that could give 4.9 kN (sheet: 160 N m).
    drive_force: float = 2700.0
    max_speed: float = 30.0 / 3.6  # speed at which the motor's limiter sets in, m/s; paper 4.2.4: 30 km/h
    # Speed range over which the limiter reduces the drive to zero, m/s; chosen: a tenth of the speed.
    limiter_band: float = 3.0 / 3.6
    # Braking force at the tyres without throttle, N; chosen: 2.2 m/s^2, a strong one-pedal mode (UN R13-H requires
    # brake lights above 1.3).
    regenerative_force: float = 2650.0
    # Speed below which regeneration fades out, m/s; chosen: walking pace, 5 km/h, where such motors stop generating.
    fade_speed: float = 5.0 / 3.6
    # Throttle that neither drives nor brakes above the fade speed, 0 to 1; chosen: one-pedal maps use about the first
    # fifth for braking.
    neutral_throttle: float = 0.2

    substeps: int = 12  # physics substeps per step of 1/20 s; chosen: 12 (240 Hz); for the reason see `BulletVehicle`
    solver_iterations: int = 50  # iterations of projected Gauss-Seidel per substep; chosen: Bullet's default of 50

    def adjusted(self, *, friction: float, payload: float) -> BulletParameters:
        """Copy as `ds_sim.parts.Vehicle.adjust` has it; springs and dampers stay those of the car."""
        mass = self.mass * (1.0 + payload)
        heavier = (mass - 4.0 * self.unsprung_mass) / self.sprung_mass
        return dataclasses.replace(
            self,
            mass=mass,
            ride_frequency=self.ride_frequency / math.sqrt(heavier),
            damping_ratio=self.damping_ratio / math.sqrt(heavier),
            friction=self.friction * friction,
        )

    @property
    def sprung_mass(self) -> float:
        """Mass of the body, kg."""
        return self.mass - 4.0 * self.unsprung_mass

    @property
    def body_forward(self) -> float:
        """Distance of the sprung mass's centre ahead of the midpoint between the axles, m."""
        return self.mass * (self.front_share - 0.5) * self.wheelbase / self.sprung_mass

    @property
    def body_inertia(self) -> tuple[float, float, float]:
        """Inertia of the body about its own axes (x, y, z), kg m^2: that of a uniform box of the body's size."""
        x, y, z = self.length**2, self.width**2, (self.height - self.ground_clearance) ** 2
        return (
            self.sprung_mass * (y + z) / 12.0,
            self.sprung_mass * (x + z) / 12.0,
            self.sprung_mass * (x + y) / 12.0,
        )

    def corner_load(self, *, front: bool) -> float:
        """Static load of one wheel on the ground, N."""
        return 0.5 * self.mass * GRAVITY * (self.front_share if front else 1.0 - self.front_share)

    def spring_load(self, *, front: bool) -> float:
        """Static load on one spring, N."""
        return self.corner_load(front=front) - self.unsprung_mass * GRAVITY

    def spring_stiffness(self, *, front: bool) -> float:
        """Stiffness of one spring at the wheel, N/m, such that the body oscillates at the ride frequency."""
        return self.spring_load(front=front) / GRAVITY * (math.tau * self.ride_frequency) ** 2

    def spring_damping(self, *, front: bool) -> float:
        """Damping of one damper at the wheel, N s/m."""
        sprung = self.spring_load(front=front) / GRAVITY
        return 2.0 * self.damping_ratio * math.sqrt(self.spring_stiffness(front=front) * sprung)

    def drive_torque(self, throttle: float, speed: float) -> float:
        """Motor torque on each rear wheel, N m, positive forward, at a throttle and the speed of its tyres, m/s."""
        fade = min(max(speed / self.fade_speed, 0.0), 1.0)
        neutral = self.neutral_throttle * fade
        if throttle >= neutral:
            limiter = min(max((self.max_speed + self.limiter_band - speed) / self.limiter_band, 0.0), 1.0)
            force = self.drive_force * (throttle - neutral) / (1.0 - neutral) * limiter
        else:
            force = -self.regenerative_force * fade * (neutral - throttle) / neutral
        return 0.5 * force * self.wheel_radius

    def wheel_angles(self, angle: float) -> tuple[float, float]:
        """Angles of the left and the right front wheel for a mean angle, rad, left positive: exact Ackermann."""
        curvature = math.tan(angle) / self.wheelbase
        half = 0.5 * self.track * curvature
        ahead = self.wheelbase * curvature
        return math.atan2(ahead, 1.0 - half), math.atan2(ahead, 1.0 + half)

    def mean_angle(self, left: float, right: float) -> float:
        """Mean angle of two front wheels, rad, left positive; inverse of `wheel_angles`."""
        left_tan, right_tan, half = math.tan(left), math.tan(right), 0.5 * self.track / self.wheelbase
        return math.atan(0.5 * (left_tan / (1.0 + half * left_tan) + right_tan / (1.0 - half * right_tan)))
