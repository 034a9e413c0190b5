"""The three vehicles as the tests of evidence see them: a car to drive, and what the textbook makes of its constants.

Where a mechanism is not part of the textbook's model (Ackermann's toe, the servo's play and delay), the car is made
without it; each has a test of its own beside the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from tests.evidence.bicycle import GRAVITY, Axle, SingleTrack

from ds_sim.simulator import FRAME_TIME, Command, VehicleState
from ds_sim.vehicle import Vehicle
from ds_sim_bullet.parameters import BulletParameters
from ds_sim_bullet.vehicle import BulletVehicle
from ds_sim_softbody.parameters import SoftbodyParameters
from ds_sim_softbody.vehicle import SoftbodyVehicle
from ds_twin_donkey.parameters import SCALE, DonkeyParameters
from ds_twin_donkey.vehicle import DonkeyVehicle

B, S, D = BulletParameters(), SoftbodyParameters(), DonkeyParameters()


@dataclass(frozen=True, kw_only=True)
class Subject:
    """One vehicle under test; lengths in road metres unless a name says otherwise.

    Attributes:
        make: the car for tests of handling.
        model: what the textbook makes of it.
        lock: steering angle at full lock, rad.
        steering_rate: rad/s; infinite for at once.
        steering_delay: s from a command to the first angle that the tyres feel.
        mass: that is to be slowed, kg (rotating parts included), in the vehicle's own scale.
        coasting_force: constant part without throttle, N.
        regeneration: part without throttle that grows with speed up to `fade_speed`, N.
        fade_speed: own m/s.
        coasting_delay: s that the car drives on as before after the throttle is lifted, at 7 road m/s.
        pitch_per_deceleration: rad per own m/s^2.
        fast: road m/s at which the understeer shows.
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

    @property
    def scale(self) -> float:
        """Road metres per metre of this vehicle."""
        return self.model.scale

    def steered(self, angle: float) -> Callable[[float], float]:
        """The front wheels' angle over time (s) after a step to an angle, rad."""

        def at(time: float) -> float:
            since = time - self.steering_delay
            return min(angle, self.steering_rate * since) if since > 0.0 else 0.0

        return at


def bullet() -> Subject:
    """Tyres that do not slip: the single track is the kinematic one."""
    ahead = B.wheelbase * (1.0 - B.front_share)
    spinning = (4 * B.wheel_spin_inertia + 2 * B.rotor_inertia) / B.wheel_radius
    front, rear = ahead, B.wheelbase - ahead
    # Springs about the body's centre of mass, which lies a little off the car's.
    front_arm, rear_arm = B.wheelbase / 2 - B.body_forward, B.wheelbase / 2 + B.body_forward
    pitch = 2 * (B.spring_stiffness(front=True) * front_arm**2 + B.spring_stiffness(front=False) * rear_arm**2)
    lever = B.sprung_mass * B.centre_of_mass_height
    return Subject(
        name="bullet",
        make=BulletVehicle,
        model=SingleTrack(mass=B.mass, yaw_inertia=1.0, front=Axle(distance=front), rear=Axle(distance=rear)),
        lock=B.max_steering_angle,
        steering_rate=B.steering_rate,
        # A substep's contacts are solved where the knuckles stood before it.
        steering_delay=FRAME_TIME / B.substeps,
        mass=B.mass + spinning / B.wheel_radius,
        coasting_force=B.rolling_resistance * B.mass * GRAVITY,
        regeneration=B.regenerative_force,
        fade_speed=B.fade_speed,
        coasting_delay=0.0,
        pitch_per_deceleration=(lever + 4 * B.unsprung_mass * B.wheel_radius + spinning) / (pitch - lever * GRAVITY),
    )


def softbody() -> Subject:
    """Parallel steering; the arms' bushes turn the wheels, as the compliance of each axle."""
    p = replace(S, ackermann=0.0)
    reach = p.track / 2.0 - p.rail_half_width
    # Of the two beams of one arm, sideways at the wheel.
    sideways = 2.0 * p.arm_stiffness * reach**2 / (reach**2 + p.bush_spacing**2)
    # The arms turn the body only: a wheel's own mass is turned by its tyre.
    carried = 0.5 * p.sprung_mass / p.mass / sideways
    half = p.mass * GRAVITY / 2.0
    lever = p.sprung_mass * p.centre_of_mass_height
    pitch = p.sprung_mass * (math.tau * p.ride_frequency * p.wheelbase / 2.0) ** 2

    def axle(stiffness: float, toe: float) -> Axle:
        # The arms are springs behind the tyre's: what they give builds the slip up over a longer way.
        relaxation = p.lateral_relaxation + 0.5 * stiffness / sideways
        return Axle(distance=p.wheelbase / 2.0, stiffness=stiffness, relaxation=relaxation,
                    damping=p.carcass_damping, compliance=toe)  # fmt: skip

    return Subject(
        name="softbody",
        make=lambda: SoftbodyVehicle(p),
        model=SingleTrack(
            mass=p.mass,
            yaw_inertia=p.yaw_inertia,
            front=axle(p.front_cornering_stiffness * half, -carried / p.front_arm),
            rear=axle(p.rear_cornering_stiffness * half, carried / p.rear_arm),
            # The leaning body's weight goes over to the outer wheels too.
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
    """Parallel steering, a servo that is at once where it is told to be; model metres inside."""
    p = D.changed(ackermann=0.0, servo_backlash=0.0, servo_lag=1e-6, servo_rate=1e6, command_delay=0.0)
    half = p.mass * GRAVITY / 2.0
    axle = {"distance": p.wheelbase / 2.0, "relaxation": p.relaxation_length, "damping": p.carcass_damping}
    lever = p.mass * p.centre_of_mass_height
    roll = p.roll_inertia * (math.tau * p.roll_frequency) ** 2
    # Lifted at 7 road m/s, the decaying voltage still drives until it meets the motor's back-EMF: by half, on average.
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


SUBJECTS = {"bullet": bullet, "softbody": softbody, "donkey": donkey}


def drive(vehicle: Vehicle, frames: int, steering: float, throttle: float) -> list[VehicleState]:
    """States at the ends of so many frames under one command."""
    states = []
    for _ in range(frames):
        vehicle.advance(Command(steering, throttle))
        states.append(vehicle.state())
    return states


def started(subject: Subject) -> Vehicle:
    """The car at rest in the origin."""
    vehicle = subject.make()
    vehicle.reset(0.0, 0.0, 0.0, np.random.default_rng(0))
    return vehicle


def settled(vehicle: Vehicle, speed: float, *, frames: int = 240) -> float:
    """Bring a car to a speed (road m/s) straight ahead and find the throttle that keeps it there."""
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
    """Of the frames after a change of command, s, the moment itself included."""
    return np.arange(frames + 1, dtype=np.float64) * np.float64(FRAME_TIME)
