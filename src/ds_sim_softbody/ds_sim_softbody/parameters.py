# SPDX-License-Identifier: Apache-2.0
"""All constants of the soft car and of the engine that integrates it, in SI units.

Sources cited repeatedly below:

* *sheet*: data sheet of the Honda e (2020), a small rear-wheel-drive electric city car with one-pedal driving.
* *Gillespie*: Fundamentals of Vehicle Dynamics, SAE 1992.
* *Pacejka*: Tire and Vehicle Dynamics, 3rd edition, 2012.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True, kw_only=True)
class SoftbodyParameters:
    """Parameters of the car: frame of nodes and beams, springs, tyres, steering and motor."""

    length: float = 3.894  # m; sheet
    width: float = 1.752  # m; sheet
    wheelbase: float = 2.53  # m; sheet
    track: float = 1.51  # distance between the wheels of an axle, m; sheet: 1.51 front and 1.505 rear
    mass: float = 1514.0  # mass in running order, kg; sheet
    front_share: float = 0.5  # share of the static load on the front axle, 0 to 1; sheet: equal on both axles
    # kg m^2; Gillespie ch. 6: close to the mass times both distances between axle and centre of mass; chosen: 0.95 of
    # that.
    yaw_inertia: float = 2300.0
    # m; chosen: 0.34 of the car's height of 1.512 (Gillespie: 0.35 to 0.4), because the battery is under the floor.
    centre_of_mass_height: float = 0.52

    # Mass of one corner, which is a node of its own, kg; Gillespie ch. 5: usually 13 to 15% of the sprung mass; chosen:
    # 40, 12%, for struts and alloy wheels.
    unsprung_mass: float = 40.0
    # Mass of each of the four outermost frame nodes, kg; chosen: bumper beam, crash box, lamps.
    bumper_mass: float = 30.0
    # Distance of a side rail from the centre line at axles and bumpers, m; chosen: just inside the wheels.
    rail_half_width: float = 0.50
    # Distance of a sill from the centre line between the axles, m; chosen: 0.13 inside the outer skin.
    sill_half_width: float = 0.75
    # Distance of the outermost frame nodes from the centre, m; chosen: 0.2 inside the outer skin.
    bumper_distance: float = 1.75
    # Distance from a wheel's axis forward and back to the two bushes of its arm, m; chosen: typical of lower arms, 0.3
    # to 0.4 from bush to bush.
    bush_spacing: float = 0.20
    # Distance of the two floor stations from the centre, m; chosen: ends of the battery case.
    floor_distance: float = 0.40
    # Stiffness of a frame beam, N/m; chosen: the first free in-plane mode of the frame, including the wheels on their
    # bushes, is then at 14 Hz, about half the 25 to 40 of a trimmed body: a soft frame.
    frame_stiffness: float = 6e6
    frame_damping: float = 5e3  # damping of a frame beam, N s/m; chosen: a few per cent of critical at that mode
    # Stiffness of a beam from wheel to bush, N/m; chosen: compliance of 0.7 mm/kN laterally and 1.1 mm/kN
    # longitudinally at the wheel; rubber-bushed struts have 0.3 to 1 and 1 to 3.
    arm_stiffness: float = 1.2e6
    # Damping of a beam from wheel to bush, N s/m; chosen: filled rubber, a loss factor of about 0.2.
    arm_damping: float = 2e3
    # Distance from a front wheel's axis forward to its track rod, m; chosen: usually 0.11 to 0.15.
    front_arm: float = 0.13
    # Distance from a rear wheel's axis back to its toe link, m; chosen: the strut's widely spaced lower links.
    rear_arm: float = 0.25

    ride_frequency: float = 1.3  # natural frequency of the body on its springs, Hz; Gillespie ch. 5: 1 to 1.5.
    # Steady-state roll angle per lateral acceleration, rad per m/s^2; Gillespie ch. 6: 5 to 7 degrees per g for small
    # cars; chosen: 4.5, because the battery is low.
    roll_gradient: float = math.radians(4.5) / GRAVITY
    # Share of the roll stiffness on the front axle, 0 to 1; Gillespie ch. 6: larger at the front, so that the car
    # understeers.
    roll_front_share: float = 0.58
    roll_axis_height: float = 0.10  # m; chosen: strut axles have 0.05 to 0.15
    # Inertia of the sprung mass about the roll axis, kg m^2; a uniform box of 1.75 x 1.1 m.
    roll_inertia: float = 720.0
    pitch_inertia: float = 2220.0  # inertia of the sprung mass about the ground, kg m^2; a uniform box of 3.9 x 1.1 m
    body_damping: float = 0.30  # damping ratio of the roll and pitch modes; Gillespie ch. 5: 0.2 to 0.4.

    wheel_radius: float = 0.315  # m; sheet: 185/60 R16 front (0.314) and 205/55 R16 rear (0.316)
    # Inertia of a wheel about its axle, kg m^2; chosen: a 17 kg wheel with 0.6 of its mass at the tread.
    wheel_spin_inertia: float = 1.0
    # Inertia of the motor at one rear wheel, kg m^2; chosen: 0.02 kg m^2 geared 9 to 1, halved.
    rotor_inertia: float = 0.8
    friction: float = 1.0  # friction coefficient of a tyre on dry asphalt at the static load; Pacejka ch. 1: about 1.
    # Relative loss of friction per relative increase of load; Pacejka ch. 4: 0.05 to 0.2.
    load_sensitivity: float = 0.10
    # Cornering stiffness over load, 1/rad; Pacejka ch. 1: 10 to 20 for passenger tyres.
    front_cornering_stiffness: float = 15.0
    # Cornering stiffness over load, 1/rad; as above, the rear tyres are 10% wider.
    rear_cornering_stiffness: float = 17.0
    # Longitudinal slip stiffness over load; Pacejka ch. 4: about 1.5 times the cornering stiffness.
    slip_stiffness: float = 22.0
    lateral_relaxation: float = 0.40  # relaxation length, m; Pacejka ch. 7: of the order of the wheel's radius.
    longitudinal_relaxation: float = 0.20  # relaxation length, m; Pacejka ch. 7: about half the lateral one.
    # Time constant of the carcass as a spring with a damper, s; chosen: 4 ms, a loss factor of 0.2 to 0.8 at the
    # frequencies at which a standing car rocks on its tyres (8 to 30 Hz).
    carcass_damping: float = 0.004
    rolling_resistance: float = 0.012  # force over load; Gillespie ch. 4: 0.012 to 0.015 for radial tyres on asphalt.
    rolling_threshold: float = 0.05  # speed below which rolling resistance fades out, m/s; chosen

    # Mean angle of the front wheels for |steering| = 1, rad; sheet: a turning circle of 8.6 m from kerb to kerb gives
    # the rear axle's centre a radius of 2.55 m (45 degrees); chosen: 42, the angle before the rack reaches its stops.
    max_steering_angle: float = math.radians(42.0)
    # Largest rate of the mean angle, rad/s; chosen: 100 degrees/s, 1,240 at the steering wheel (sheet: 3.1 turns for 90
    # degrees), within what steering robots reach (1,000 to 2,500).
    steering_rate: float = math.radians(100.0)
    # Share of the exact Ackermann geometry, 0 parallel to 1 exact; chosen: linkages built for a small turning circle
    # come close.
    ackermann: float = 0.9

    # Force at the tyres at full throttle, N; chosen: 0 to 20 km/h in 3 s under the paper's equation 2; the motor could
    # give 9 kN (sheet: 315 N m).
    drive_force: float = 4600.0
    power: float = 100e3  # power at the tyres, W; sheet: 100 kW; never reached in the tests
    top_speed: float = 145.0 / 3.6  # speed at which the motor stops driving, m/s; sheet: 145 km/h
    # Braking force at the tyres without throttle, N; sheet: one-pedal control decelerates by up to 0.18 g.
    regenerative_force: float = 0.18 * 1514.0 * GRAVITY
    fade_speed: float = 1.5  # speed below which regeneration fades out, m/s; chosen: walking pace, 5.4 km/h
    # Time constant from pedal to torque, s; chosen: the filter that protects the driveline, 0.05 to 0.1.
    motor_lag: float = 0.06

    # Substeps of nodes, beams and tyres per step of 1/20 s; chosen: 50 (1 kHz): the fastest mode of the beams is at 0.4
    # of the stability limit of the explicit integration, and halving the substep moves the end of a drive of 12 s by 1
    # cm.
    frame_substeps: int = 50
    # Substeps of roll, pitch, steering and motor per step, a divisor of `frame_substeps`; chosen: 10 (200 Hz), a
    # hundred times the frequencies of the body's modes.
    body_substeps: int = 10
    # Solver iterations for the beams' damping per substep; chosen: 2; ten change that drive by less than 1 um.
    solver_iterations: int = 2

    def adjusted(self, *, friction: float, payload: float) -> SoftbodyParameters:
        """Copy as `ds_sim.parts.Vehicle.adjust` has it; springs and dampers stay those of the car."""
        if (friction, payload) == (1.0, 0.0):
            return self
        grown = 1.0 + payload
        mass = self.mass * grown
        heavier = (mass - 4.0 * self.unsprung_mass) / self.sprung_mass
        # The leaning body adds m g h to the moment that the springs hold: the gradient grows faster than the mass.
        lean = (self.centre_of_mass_height - self.roll_axis_height) * self.sprung_mass
        gradient = heavier * lean / (lean / self.roll_gradient + lean * GRAVITY * (1.0 - heavier))
        return dataclasses.replace(
            self,
            mass=mass,
            yaw_inertia=self.yaw_inertia * grown,
            roll_inertia=self.roll_inertia * heavier,
            pitch_inertia=self.pitch_inertia * heavier,
            ride_frequency=self.ride_frequency / math.sqrt(heavier),
            roll_gradient=gradient,
            body_damping=self.body_damping / math.sqrt(heavier),
            # The reference load of these grows with the mass.
            friction=self.friction * friction * (1.0 - self.load_sensitivity * payload),
        )

    @property
    def sprung_mass(self) -> float:
        """Mass of the body, kg."""
        return self.mass - 4.0 * self.unsprung_mass

    @property
    def centre_of_mass_ahead(self) -> float:
        """Distance of the centre of mass ahead of the midpoint between the axles, m."""
        return self.wheelbase * (self.front_share - 0.5)
