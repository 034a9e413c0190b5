# SPDX-License-Identifier: Apache-2.0
"""Dynamics of the 1:16 car: actuators, four tyres, a body that rolls and pitches.

A planar four-wheel model (Pacejka, Tire and Vehicle Dynamics, ch. 1) describes longitudinal, lateral and yaw motion,
with load transfer through the springs in roll and pitch. Tyres follow the Magic Formula, with slip that builds up over
the relaxation length (ch. 7), so that nothing is divided by speed and the model is valid down to standstill.
Integration is by Runge-Kutta with a fixed step, in functions compiled by `advance`. Lengths are in model metres; signs
as in `ds_sim.simulator.VehicleState`.
"""

from __future__ import annotations

import math
from ctypes import c_int64, c_void_p
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ds_sim.machine_code import layout, load, values
from ds_sim.simulator import FRAME_TIME, Command
from ds_twin_donkey.parameters import GRAVITY, DonkeyParameters

SUBSTEPS = 20
"""Substeps per step of 1/20 s, 2.5 ms each; chosen: the fastest mode (tyre and body) is at about 60 rad/s."""
STEP = FRAME_TIME / SUBSTEPS
"""Substep, s."""
STANDSTILL_SPEED = 0.002
"""Speed below which friction holds a car that is not driven, m/s (0.03 road m/s)."""
MAX_SLIP = 1.5
"""Tangent of the slip angle at which the deflection of a sliding tyre stops growing; past the peak of its force."""


class CarState(NamedTuple):
    """State of the car at a frame; SI units of the model car."""

    x: float = 0.0  # position of the centre of mass, m
    y: float = 0.0  # position of the centre of mass, m
    yaw: float = 0.0  # rad, counter-clockwise
    speed: float = 0.0  # forward, of the centre of mass, m/s
    lateral_speed: float = 0.0  # to the left, of the centre of mass, m/s
    yaw_rate: float = 0.0  # rad/s
    roll: float = 0.0  # rad, right side down positive
    roll_rate: float = 0.0  # rad/s
    pitch: float = 0.0  # rad, nose down positive
    pitch_rate: float = 0.0  # rad/s
    slip_front_left: float = 0.0  # tangent of the current slip angle
    slip_front_right: float = 0.0  # the same
    slip_rear_left: float = 0.0  # the same
    slip_rear_right: float = 0.0  # the same
    servo: float = 0.0  # current position of the servo as an angle at the wheels, rad, left positive
    steering_angle: float = 0.0  # mean angle of the front wheels after play, rad, left positive
    duty: float = 0.0  # duty of the motor after the lag of the speed controller, 0 to 1


@dataclass(frozen=True, kw_only=True, slots=True)
class Constants:
    """What follows from the parameters of a car and a substep, s.

    Distances are those from the centre of mass to an axle, m, loads the static ones of a wheel, N, damping and
    stiffness those of the leaning body, N m s/rad and N m/rad.
    """

    step: float
    to_front: float
    to_rear: float
    front_load: float
    rear_load: float
    roll_damping: float
    pitch_damping: float
    roll_stiffness: float
    pitch_stiffness: float
    breakaway: float  # force below which friction holds a standing car, N
    motor_gain: float  # share of the way to a new duty that the motor covers in a substep

    @classmethod
    def of(cls, p: DonkeyParameters, step: float) -> Constants:
        """Constants of a car with a substep, s."""
        weight = p.mass * GRAVITY
        # The weight of the leaning body acts against the springs: they are stiffer by m g h than the frequency implies.
        lean = weight * p.centre_of_mass_height
        return cls(
            step=step,
            to_front=p.wheelbase * (1.0 - p.front_share),
            to_rear=p.wheelbase * p.front_share,
            front_load=0.5 * weight * p.front_share,
            rear_load=0.5 * weight * (1.0 - p.front_share),
            roll_damping=2.0 * p.body_damping * p.roll_inertia * math.tau * p.roll_frequency,
            pitch_damping=2.0 * p.body_damping * p.pitch_inertia * math.tau * p.pitch_frequency,
            roll_stiffness=p.roll_inertia * (math.tau * p.roll_frequency) ** 2 + lean,
            pitch_stiffness=p.pitch_inertia * (math.tau * p.pitch_frequency) ** 2 + lean,
            breakaway=p.rolling_resistance * weight,
            motor_gain=-math.expm1(-step / p.motor_lag),
        )


MOTION = 14
"""Number of states of motion, the first of `CarState`."""
CAR = np.dtype(
    [
        ("parameters", layout(DonkeyParameters)),
        ("constants", layout(Constants)),
        ("slopes", np.float64, (4, MOTION)),
        ("trial", np.float64, (MOTION,)),
    ]
)
"""Record of a car, with room for the slopes of a Runge-Kutta step and the state at which they are taken."""


class CarModel:
    """Advances a car by whole steps of some substeps; stateless, holds only constants derived from the parameters."""

    def __init__(self, parameters: DonkeyParameters, *, substeps: int = SUBSTEPS) -> None:
        p = self.parameters = parameters
        step = FRAME_TIME / substeps
        self._car = np.zeros(1, CAR)
        self._car[0]["parameters"], self._car[0]["constants"] = values(p), values(Constants.of(p, step))
        frames_of_delay, rest = divmod(p.command_delay, FRAME_TIME)
        self.frames_kept = int(frames_of_delay) + 2
        """Number of commands that a step needs, up to that of its own frame."""
        ends = (np.arange(substeps) + 1.0) * step
        newer = np.clip((ends - rest) / step, 0.0, 1.0)
        # Per substep: share of the newer pulse, and gain and largest move of the servo under either pulse.
        gains = [(-np.expm1(-part * step / p.servo_lag), part * step * p.servo_rate) for part in (1.0 - newer, newer)]
        self._shares = np.column_stack([newer, *gains[0], *gains[1]])
        self._advance = load("ds_twin_donkey.advance", *[c_void_p] * 2, c_int64, *[c_void_p] * 2, c_int64)

    def run(self, state: ArrayLike, commands: ArrayLike) -> NDArray[np.float64]:
        """Return the states from a given one on, (steps + 1, 17), columns as in `CarState`.

        Commands are steering and throttle by frames, (steps + `frames_kept` - 1, 2), that of the last step last.
        """
        rows = np.ascontiguousarray(commands, np.float64)
        states = np.empty((len(rows) - self.frames_kept + 2, len(CarState._fields)))
        states[0] = state
        self._advance(
            self._car.ctypes.data,
            self._shares.ctypes.data,
            len(self._shares),
            states.ctypes.data,
            rows.ctypes.data,
            len(states) - 1,
        )
        return states


def pulse(p: DonkeyParameters, steering: float, throttle: float) -> tuple[float, float, float]:
    """Convert a command to whole pulse counts: angle of the wheels (rad, left positive), duty of the motor, brake.

    The brake, in the dead band, is a share of that of the shorted motor.
    """
    angle = p.steering_trim - np.rint(steering * p.steering_pulse_steps) / p.steering_pulse_steps * p.max_steering_angle
    # The edge of the dead band itself counts as driving.
    counts = np.rint(throttle * p.throttle_pulse_steps) / p.throttle_pulse_steps
    above = (counts - p.throttle_dead_band) / (1.0 - p.throttle_dead_band)
    if above < 0.0:
        return angle, 0.0, p.drag_brake
    return angle, p.start_duty + (p.full_duty - p.start_duty) * above, 0.0


def move(car: Any, s: NDArray[np.float64], steering: float, duty: float, brake: float) -> None:
    """Take one Runge-Kutta step of the motion in place, with mean angle (rad, left positive), duty and brake held."""
    p, c, k, trial = car.parameters, car.constants, car.slopes, car.trial
    held = (
        p.stall_force * duty <= c.breakaway
        and abs(s[3]) < STANDSTILL_SPEED
        and abs(s[4]) < STANDSTILL_SPEED
        and abs(s[5]) * p.wheelbase < STANDSTILL_SPEED
    )
    if held:
        s[3:6] = 0.0
        s[10:14] = 0.0
    left, right = wheel_angles(p, steering)
    wheels = (math.cos(left), math.sin(left), math.cos(right), math.sin(right), duty, brake)
    h, half = c.step, 0.5 * c.step
    slopes(p, c, s, wheels, held, k[0])
    for n, part in ((0, half), (1, half), (2, h)):
        for i in range(MOTION):
            trial[i] = s[i] + part * k[n, i]
        slopes(p, c, trial, wheels, held, k[n + 1])
    sixth = h / 6.0
    for i in range(MOTION):
        s[i] += sixth * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])


def wheel_angles(p: DonkeyParameters, steering: float) -> tuple[float, float]:
    """Angles of the left and right wheel for a mean angle: parallel at an Ackermann share of 0, concentric at 1."""
    t = math.tan(steering)
    side = 0.5 * p.ackermann * p.track * t / p.wheelbase
    return math.atan(t / (1.0 - side)), math.atan(t / (1.0 + side))


def slopes(
    p: DonkeyParameters,
    c: Constants,
    s: NDArray[np.float64],
    wheels: tuple[float, float, float, float, float, float],
    held: bool,
    out: NDArray[np.float64],
) -> None:
    """Write the time derivatives of the 14 states of motion to `out`."""
    yaw, u, v, r, roll, roll_rate, pitch, pitch_rate = s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9]
    cos_l, sin_l, cos_r, sin_r, duty, brake = wheels
    front, rear, half_track = c.to_front, c.to_rear, 0.5 * p.track

    roll_moment = c.roll_stiffness * roll + c.roll_damping * roll_rate
    pitch_moment = c.pitch_stiffness * pitch + c.pitch_damping * pitch_rate
    push, side = 0.0, 0.0
    out[3:6] = 0.0
    out[10:14] = 0.0
    if not held:
        # Roll and pitch moments of the springs change the loads of the wheels.
        along = 0.5 * pitch_moment / p.wheelbase
        across_front = p.roll_front_share * roll_moment / p.track
        across_rear = (1.0 - p.roll_front_share) * roll_moment / p.track
        drive = p.stall_force * (max(duty - u / p.free_speed, 0.0) - brake * u / p.free_speed)
        front_drive = 0.5 * drive * p.drive_front_share
        rear_drive = 0.5 * drive - front_drive

        speed_front, speed_rear = v + front * r, v - rear * r
        u_left, u_right = u - half_track * r, u + half_track * r
        a1, f1, out[10] = tyre(
            p,
            u_left * cos_l + speed_front * sin_l,
            speed_front * cos_l - u_left * sin_l,
            s[10],
            c.front_load + along - across_front,
            c.front_load,
            p.front_stiffness,
            front_drive,
        )
        a2, f2, out[11] = tyre(
            p,
            u_right * cos_r + speed_front * sin_r,
            speed_front * cos_r - u_right * sin_r,
            s[11],
            c.front_load + along + across_front,
            c.front_load,
            p.front_stiffness,
            front_drive,
        )
        a3, f3, out[12] = tyre(
            p, u_left, speed_rear, s[12], c.rear_load - along - across_rear, c.rear_load, p.rear_stiffness, rear_drive
        )
        a4, f4, out[13] = tyre(
            p, u_right, speed_rear, s[13], c.rear_load - along + across_rear, c.rear_load, p.rear_stiffness, rear_drive
        )
        x1, y1 = a1 * cos_l - f1 * sin_l, a1 * sin_l + f1 * cos_l
        x2, y2 = a2 * cos_r - f2 * sin_r, a2 * sin_r + f2 * cos_r
        out[3] = (x1 + x2 + a3 + a4 + p.mass * v * r) / (p.mass + p.rotating_mass)
        out[4] = (y1 + y2 + f3 + f4) / p.mass - u * r
        out[5] = (front * (y1 + y2) - rear * (f3 + f4) + half_track * (x2 - x1 + a4 - a3)) / p.yaw_inertia
        push, side = out[3] - v * r, out[4] + u * r

    arm = p.mass * p.centre_of_mass_height
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    out[0], out[1], out[2] = u * cos_yaw - v * sin_yaw, u * sin_yaw + v * cos_yaw, r
    out[6], out[7] = roll_rate, (arm * (side + GRAVITY * roll) - roll_moment) / p.roll_inertia
    out[8], out[9] = pitch_rate, (arm * (GRAVITY * pitch - push) - pitch_moment) / p.pitch_inertia


def tyre(
    p: DonkeyParameters,
    along: float,
    across: float,
    slip: float,
    load: float,
    rated: float,
    stiffness: float,
    drive: float,
) -> tuple[float, float, float]:
    """Forces along and across a wheel (N) and rate of its slip (1/s), from its velocities along and across."""
    rate = (across - abs(along) * slip) / p.relaxation_length
    if abs(slip) > MAX_SLIP and slip * rate > 0.0:
        rate = 0.0
    if load <= 0.0:
        return 0.0, 0.0, rate
    friction = p.friction * (1.0 - p.load_sensitivity * (load / rated - 1.0))
    grip = friction * load
    force = drive - p.rolling_resistance * load * along / math.sqrt(along * along + STANDSTILL_SPEED * STANDSTILL_SPEED)
    force = min(max(force, -grip), grip)
    deflection = slip + p.carcass_damping * rate
    lateral = math.sin(p.shape * math.atan(stiffness / (p.shape * friction) * deflection))
    return force, -lateral * math.sqrt(grip * grip - force * force), rate


def rollout(
    parameters: DonkeyParameters, commands: ArrayLike, initial_state: CarState | None = None
) -> NDArray[np.float64]:
    """Simulate commands by steps of 1/20 s, from a state or at rest at the origin.

    The commands are (n, 2): steering in [-1, 1] and throttle in [0, 1]. Neutral ones are assumed before the first.
    Returns (n + 1, 17) states, columns as in `CarState`, the initial one first. ValueError for commands of another
    shape, CommandError for one that is no number or out of range.
    """
    rows = np.asarray(commands, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise ValueError(f"commands have shape {rows.shape}, expected (n, 2): steering and throttle per frame")
    for row in rows.tolist():
        Command(*row)
    model = CarModel(parameters)
    return model.run(initial_state or CarState(), np.vstack((np.zeros((model.frames_kept - 1, 2)), rows)))
