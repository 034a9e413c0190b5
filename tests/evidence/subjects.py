# SPDX-License-Identifier: Apache-2.0
"""The four vehicles under test: a car to drive, and the textbook model with its constants.

Mechanisms outside the textbook model (Ackermann toe, play and delay of the servo) are switched off; the tests of each
vehicle cover them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from tests.evidence.bicycle import GRAVITY, Axle, SingleTrack
from tests.observations import drive

from ds_sim.parts import Vehicle
from ds_sim.simulator import FRAME_TIME, Command
from ds_sim_bullet.parameters import BulletParameters
from ds_sim_bullet.vehicle import BulletVehicle
from ds_sim_panda.simulator import MultiBodyVehicle
from ds_sim_panda.vehicle.parameters import MultiBodyParameters
from ds_sim_softbody.parameters import SoftbodyParameters
from ds_sim_softbody.simulator import SoftbodyVehicle
from ds_twin_donkey.parameters import SCALE, DonkeyParameters
from ds_twin_donkey.simulator import DonkeyVehicle

B, S, D, M = BulletParameters(), SoftbodyParameters(), DonkeyParameters(), MultiBodyParameters()


@dataclass(frozen=True, kw_only=True)
class Subject:
    """One vehicle under test; lengths in road metres unless stated otherwise ("model" is the vehicle's own scale).

    Attributes:
        name: name of the simulator.
        make: makes the car for the handling tests.
        model: textbook model of the car.
        lock: steering angle at full lock, rad.
        steering_rate: rad/s; infinite if instantaneous.
        steering_delay: time from a command to the first change of the angle at the tyres, s.
        mass: effective mass including rotating parts, model scale, kg.
        coasting_force: constant part of the braking force without throttle, N.
        regeneration: part of the braking force without throttle that grows with speed up to `fade_speed`, N.
        fade_speed: model m/s.
        coasting_delay: time for which the car continues to be driven after the throttle is lifted at 7 road m/s, s.
        pitch_per_deceleration: rad per model m/s^2.
        fast: speed at which understeer is measurable, road m/s.
        circle: steering of the steady circles.
        sudden: textbook model of a steering step, if other than `model`.
        absolute: True if the understeer is too small for a relative tolerance.
    """

    name: str
    make: Callable[[], Vehicle]
    model: SingleTrack
    lock: float
    steering_rate: float
    steering_delay: float
    mass: float
    coasting_force: float
    regeneration: float
    fade_speed: float
    coasting_delay: float
    pitch_per_deceleration: float
    fast: float = 7.0
    circle: float = 9 / 85
    sudden: SingleTrack | None = None
    absolute: bool = False

    @property
    def scale(self) -> float:
        """Road metres per model metre."""
        return self.model.scale

    def steered(self, angle: float) -> Callable[[float], float]:
        """Angle of the front wheels (rad) over time (s) after a step to an angle."""

        def at(time: float) -> float:
            elapsed = time - self.steering_delay
            return min(angle, self.steering_rate * elapsed) if elapsed > 0.0 else 0.0

        return at


def bullet() -> Subject:
    """Rigid car: its tyres do not slip, so the single-track model is the kinematic one."""
    ahead = B.wheelbase * (1.0 - B.front_share)
    spinning = (4 * B.wheel_spin_inertia + 2 * B.rotor_inertia) / B.wheel_radius
    front, rear = ahead, B.wheelbase - ahead
    # The body's centre of mass, about which the springs act, is slightly off that of the car.
    front_arm, rear_arm = B.wheelbase / 2 - B.body_forward, B.wheelbase / 2 + B.body_forward
    pitch = 2 * (B.spring_stiffness(front=True) * front_arm**2 + B.spring_stiffness(front=False) * rear_arm**2)
    lever = B.sprung_mass * B.centre_of_mass_height
    return Subject(
        name="bullet",
        make=BulletVehicle,
        model=SingleTrack(mass=B.mass, yaw_inertia=1.0, front=Axle(distance=front), rear=Axle(distance=rear)),
        lock=B.max_steering_angle,
        steering_rate=B.steering_rate,
        # The contacts of a substep are solved with the knuckles where they were before it.
        steering_delay=FRAME_TIME / B.substeps,
        mass=B.mass + spinning / B.wheel_radius,
        coasting_force=B.rolling_resistance * B.mass * GRAVITY,
        regeneration=B.regenerative_force,
        fade_speed=B.fade_speed,
        coasting_delay=0.0,
        pitch_per_deceleration=(lever + 4 * B.unsprung_mass * B.wheel_radius + spinning) / (pitch - lever * GRAVITY),
    )


def softbody() -> Subject:
    """Soft car with parallel steering; the bushes of the arms give each axle a steering compliance."""
    p = replace(S, ackermann=0.0)
    reach = p.track / 2.0 - p.rail_half_width
    # Lateral stiffness of the two beams of one arm at the wheel.
    sideways = 2.0 * p.arm_stiffness * reach**2 / (reach**2 + p.bush_spacing**2)
    # The arms accelerate the body only: the mass of a wheel is accelerated by its tyre.
    carried = 0.5 * p.sprung_mass / p.mass / sideways
    half = p.mass * GRAVITY / 2.0
    lever = p.sprung_mass * p.centre_of_mass_height
    pitch = p.sprung_mass * (math.tau * p.ride_frequency * p.wheelbase / 2.0) ** 2

    def axle(stiffness: float, toe: float) -> Axle:
        # The arms are springs in series with the tyre: their flex lengthens the distance over which slip builds up.
        relaxation = p.lateral_relaxation + 0.5 * stiffness / sideways
        return Axle(
            distance=p.wheelbase / 2.0,
            stiffness=stiffness,
            relaxation=relaxation,
            damping=p.carcass_damping,
            compliance=toe,
        )

    return Subject(
        name="softbody",
        make=lambda: SoftbodyVehicle(p),
        model=SingleTrack(
            mass=p.mass,
            yaw_inertia=p.yaw_inertia,
            front=axle(p.front_cornering_stiffness * half, -carried / p.front_arm),
            rear=axle(p.rear_cornering_stiffness * half, carried / p.rear_arm),
            # The weight of the leaning body also loads the outer wheels.
            turning_resistance=p.rolling_resistance
            * (
                p.mass * p.centre_of_mass_height
                + p.sprung_mass * (p.centre_of_mass_height - p.roll_axis_height) * GRAVITY * p.roll_gradient
            ),
        ),
        lock=p.max_steering_angle,
        steering_rate=p.steering_rate,
        steering_delay=0.0,
        mass=p.mass + (4.0 * p.wheel_spin_inertia + 2.0 * p.rotor_inertia) / p.wheel_radius**2,
        coasting_force=p.rolling_resistance * p.mass * GRAVITY,
        regeneration=p.regenerative_force,
        fade_speed=p.fade_speed,
        coasting_delay=p.motor_lag,
        pitch_per_deceleration=lever / (pitch - lever * GRAVITY),
    )


def donkey() -> Subject:
    """Twin with parallel steering and an instantaneous servo; the model is in model metres."""
    p = D.changed(ackermann=0.0, servo_backlash=0.0, servo_lag=1e-6, servo_rate=1e6, command_delay=0.0)
    half = p.mass * GRAVITY / 2.0
    axle = {"distance": p.wheelbase / 2.0, "relaxation": p.relaxation_length, "damping": p.carcass_damping}
    lever = p.mass * p.centre_of_mass_height
    roll = p.roll_inertia * (math.tau * p.roll_frequency) ** 2
    # After lifting at 7 road m/s the decaying voltage drives until it equals the back-EMF, at half force on average.
    constant, share = p.rolling_resistance * p.mass * GRAVITY, 7.0 / SCALE / p.free_speed
    after = p.motor_lag * math.log1p(constant / p.stall_force / share)
    return Subject(
        name="donkey",
        make=lambda: DonkeyVehicle(p),
        model=SingleTrack(
            mass=p.mass,
            yaw_inertia=p.yaw_inertia,
            front=Axle(stiffness=p.front_stiffness * half, **axle),
            rear=Axle(stiffness=p.rear_stiffness * half, **axle),
            turning_resistance=p.rolling_resistance * lever * (1.0 + lever * GRAVITY / roll),
            scale=SCALE,
        ),
        lock=p.max_steering_angle,
        steering_rate=math.inf,
        steering_delay=0.0,
        mass=p.mass + p.rotating_mass,
        coasting_force=p.rolling_resistance * p.mass * GRAVITY,
        # The shorted motor brakes in proportion to speed, at any speed.
        regeneration=p.stall_force * p.drag_brake,
        fade_speed=p.free_speed,
        coasting_delay=0.5 * after * constant / (constant + p.stall_force * p.drag_brake * share),
        fast=16.0,
        pitch_per_deceleration=lever / (p.pitch_inertia * (math.tau * p.pitch_frequency) ** 2),
    )


def panda() -> Subject:
    """Multi-body car: camber by roll, and the toe of its parallel front wheels, act like steering compliances.

    The model's yaw balance is about the centre of the sprung mass, while its tyres carry the axles' weight, too: the
    front axle takes a larger share of the force than of the load.
    """
    p, tyre, circle = M.published, M.published.tire, 0.07
    wheelbase = p.a + p.b
    front_mass, rear_mass = p.m_s * p.b / wheelbase + p.m_uf, p.m_s * p.a / wheelbase + p.m_ur
    # Springs and anti-roll bar of an axle in series with its tyres, N m/rad; the published bars are negative.
    springs = (p.K_sf * p.T_f**2 / 2 - p.K_tsf, p.K_sr * p.T_r**2 / 2 - p.K_tsr)
    tyres = (p.K_zt * p.T_f**2 / 2, p.K_zt * p.T_r**2 / 2)
    series = tuple(1 / (1 / spring + 1 / rubber) for spring, rubber in zip(springs, tyres, strict=True))
    roll = p.m_s * p.h_s / (sum(series) - p.m_s * p.h_s * GRAVITY)
    # Side force by camber over load, of both shifts of the Magic Formula, as slip angle per camber.
    per_camber = tyre.p_hy3 + tyre.p_vy3 / tyre.p_ky1
    cambers = (
        roll * (1 + p.D_f * p.T_f / 2 * series[0] / springs[0]),
        roll * (1 + p.D_r * p.T_r / 2 * series[1] / springs[1]),
    )
    # Parallel wheels: the outer one, which carries more, is steered too far, the inner one too little.
    toe = p.T_f * math.sin(circle * M.max_steering_angle) ** 2 / (2 * wheelbase)
    transfer = 2 * (series[0] * roll + p.m_uf * p.R_w) / p.T_f / (front_mass * GRAVITY)
    front_force, rear_force = p.m * p.b / wheelbase, p.m * p.a / wheelbase
    # The body's height is counted from where its tyres are not deflected.
    sink = 0.5 * GRAVITY * (front_mass * p.b + rear_mass * p.a) / wheelbase / p.K_zt
    pitch = 0.5 * sum(1 / spring + 1 / p.K_zt for spring in (p.K_sf, p.K_sr)) / wheelbase**2

    def axle(distance: float, carried: float, compliance: float) -> Axle:
        # Slip angles of the model follow at once.
        return Axle(
            distance=distance, stiffness=abs(tyre.p_ky1) * carried * GRAVITY, relaxation=0.01, compliance=compliance
        )

    def model(front_compliance: float, rear_compliance: float) -> SingleTrack:
        return SingleTrack(
            mass=p.m,
            yaw_inertia=p.I_z,
            front=axle(p.a, front_mass, front_compliance),
            rear=axle(p.b, rear_mass, rear_compliance),
        )

    return Subject(
        name="panda",
        make=MultiBodyVehicle,
        model=model((per_camber * cambers[0] + toe * transfer) / front_force, per_camber * cambers[1] / rear_force),
        # A step is over before the body has rolled.
        sudden=model(0.0, 0.0),
        lock=M.max_steering_angle,
        steering_rate=p.steering.v_max,
        steering_delay=0.0,
        mass=p.m + 4 * p.I_y_w / p.R_w**2,
        coasting_force=0.0,
        regeneration=p.m * M.regenerative_deceleration,
        fade_speed=M.fade_speed,
        coasting_delay=0.0,
        pitch_per_deceleration=p.m * (p.h_s - sink) * pitch,
        circle=circle,
        absolute=True,
    )


SUBJECTS = {"bullet": bullet, "softbody": softbody, "donkey": donkey, "panda": panda}


def started(subject: Subject) -> Vehicle:
    """Make the car, at rest at the origin."""
    vehicle = subject.make()
    vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    return vehicle


def settled(vehicle: Vehicle, speed: float, *, frames: int = 240) -> float:
    """Drive straight until the car keeps a speed (road m/s); returns the throttle for it."""
    total = 0.0
    throttle = 0.0
    for _ in range(frames):
        error = speed - vehicle.state().speed
        total += 0.02 * error if abs(error) < 1.0 else 0.0
        throttle = min(max(0.5 * error + total + 0.3, 0.0), 1.0)
        vehicle.advance(Command(0.0, throttle))
    drive(vehicle, 20, 0.0, throttle)
    return throttle


def times(frames: int) -> NDArray[np.float64]:
    """Times of the frames after a change of command, including the change itself, s."""
    return np.arange(frames + 1, dtype=np.float64) * np.float64(FRAME_TIME)
