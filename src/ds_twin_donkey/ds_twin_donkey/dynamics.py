"""Dynamics of the 1:16 car: actuators, four tyres, a body that rolls and pitches.

A planar four-wheel model (Pacejka, Tire and Vehicle Dynamics, ch. 1) describes longitudinal, lateral and yaw motion,
with load transfer through the springs in roll and pitch. Tyres follow the Magic Formula, with slip that builds up over
the relaxation length (ch. 7), so that nothing is divided by speed and the model is valid down to standstill.
Integration is by Runge-Kutta with a fixed step. Lengths are in model metres; signs as in
`ds_sim.simulator.VehicleState`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

_REST = (0.0, 0.0, 0.0, 0.0)


class CarState(NamedTuple):
    """State of the car at a frame; SI units of the model car.

    Attributes:
        x: position of the centre of mass, m.
        y: position of the centre of mass, m.
        yaw: rad, counter-clockwise.
        speed: forward, of the centre of mass, m/s.
        lateral_speed: to the left, of the centre of mass, m/s.
        yaw_rate: rad/s.
        roll: rad, right side down positive.
        roll_rate: rad/s.
        pitch: rad, nose down positive.
        pitch_rate: rad/s.
        slip_front_left: tangent of the current slip angle.
        slip_front_right: the same.
        slip_rear_left: the same.
        slip_rear_right: the same.
        servo: current position of the servo as an angle at the wheels, rad, left positive.
        steering_angle: mean angle of the front wheels after play, rad, left positive.
        duty: duty of the motor after the lag of the speed controller, 0 to 1.
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    speed: float = 0.0
    lateral_speed: float = 0.0
    yaw_rate: float = 0.0
    roll: float = 0.0
    roll_rate: float = 0.0
    pitch: float = 0.0
    pitch_rate: float = 0.0
    slip_front_left: float = 0.0
    slip_front_right: float = 0.0
    slip_rear_left: float = 0.0
    slip_rear_right: float = 0.0
    servo: float = 0.0
    steering_angle: float = 0.0
    duty: float = 0.0


class Pulse(NamedTuple):
    """Input of servo and speed controller.

    Attributes:
        angle: angle of the wheels, rad, left positive.
        duty: duty of the motor, 0 to 1.
        brake: share of the shorted motor's braking, 0 to 1.
    """

    angle: float = 0.0
    duty: float = 0.0
    brake: float = 0.0


_Motion = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float, float
]  # fmt: skip


class CarModel:
    """Advances a car by whole steps; stateless, holds only constants derived from the parameters.

    Args:
        parameters: parameters of the car.
        substeps: substeps per step; `SUBSTEPS` if omitted.
    """

    def __init__(self, parameters: DonkeyParameters, *, substeps: int | None = None) -> None:
        p = self.parameters = parameters
        count = substeps or SUBSTEPS
        step = self._step = FRAME_TIME / count
        self._to_front = p.wheelbase * (1.0 - p.front_share)
        self._to_rear = p.wheelbase * p.front_share
        weight = p.mass * GRAVITY
        self._front_load = 0.5 * weight * p.front_share
        self._rear_load = 0.5 * weight * (1.0 - p.front_share)
        self._roll_damping = 2.0 * p.body_damping * p.roll_inertia * math.tau * p.roll_frequency
        self._pitch_damping = 2.0 * p.body_damping * p.pitch_inertia * math.tau * p.pitch_frequency
        # The weight of the leaning body acts against the springs: they are stiffer by m g h than the frequency implies.
        lean = weight * p.centre_of_mass_height
        self._roll_stiffness = p.roll_inertia * (math.tau * p.roll_frequency) ** 2 + lean
        self._pitch_stiffness = p.pitch_inertia * (math.tau * p.pitch_frequency) ** 2 + lean
        self._breakaway = p.rolling_resistance * weight
        self._motor_gain = -math.expm1(-step / p.motor_lag)
        self.frames_of_delay, rest = divmod(p.command_delay, FRAME_TIME)
        ends = (np.arange(count) + 1.0) * step
        newer = np.clip((ends - rest) / step, 0.0, 1.0)
        # Per substep: share of the newer pulse, and gain and largest move of the servo under either pulse.
        gains = [(-np.expm1(-part * step / p.servo_lag), part * step * p.servo_rate) for part in (1.0 - newer, newer)]
        self._shares = list(zip(newer.tolist(), *(row.tolist() for pair in gains for row in pair), strict=True))

    @property
    def pulses_kept(self) -> int:
        """Number of pulses that `advance` needs, one per frame up to the current one."""
        return int(self.frames_of_delay) + 2

    def pulse(self, command: Command) -> Pulse:
        """Convert a command to a pulse: whole pulse counts, dead band, minimum duty, drag brake."""
        p = self.parameters
        steering = round(command.steering * p.steering_pulse_steps) / p.steering_pulse_steps
        throttle = round(command.throttle * p.throttle_pulse_steps) / p.throttle_pulse_steps
        angle = p.steering_trim - steering * p.max_steering_angle
        # The edge of the dead band itself counts as driving.
        above = (throttle - p.throttle_dead_band) / (1.0 - p.throttle_dead_band)
        if above < 0.0:
            return Pulse(angle, 0.0, p.drag_brake)
        return Pulse(angle, p.start_duty + (p.full_duty - p.start_duty) * above, 0.0)

    def advance(self, state: CarState, pulses: list[Pulse]) -> CarState:
        """Return the state one step later.

        Args:
            state: state at the start of the step.
            pulses: pulses of all frames so far, the current one last; at least `pulses_kept` of them.
        """
        p = self.parameters
        older, newer = pulses[-self.pulses_kept], pulses[-self.pulses_kept + 1]
        motion: _Motion = state[:14]
        servo, wheels, duty = state.servo, state.steering_angle, state.duty
        play = p.servo_backlash / 2.0
        for share, older_gain, older_reach, newer_gain, newer_reach in self._shares:
            rest = 1.0 - share
            # Apply one pulse after the other: at its rate limit, the servo would not respond to the share of a blend.
            servo += min(max((older.angle - servo) * older_gain, -older_reach), older_reach)
            servo += min(max((newer.angle - servo) * newer_gain, -newer_reach), newer_reach)
            before = wheels
            wheels = min(max(wheels, servo - play), servo + play)
            wanted = share * newer.duty + rest * older.duty
            middle = duty + 0.5 * (wanted - duty) * self._motor_gain
            duty += (wanted - duty) * self._motor_gain
            brake = share * newer.brake + rest * older.brake
            motion = self._move(motion, 0.5 * (before + wheels), middle, brake)
        return CarState(*motion, servo, wheels, duty)

    def _move(self, s: _Motion, steering: float, duty: float, brake: float) -> _Motion:
        """Take one Runge-Kutta step of the motion, with the actuators held at their mid-step values."""
        p = self.parameters
        not_driven = p.stall_force * duty <= self._breakaway
        held = (
            not_driven
            and abs(s[3]) < STANDSTILL_SPEED
            and abs(s[4]) < STANDSTILL_SPEED
            and abs(s[5]) * p.wheelbase < STANDSTILL_SPEED
        )
        if held:
            s = (*s[:3], 0.0, 0.0, 0.0, *s[6:10], *_REST)
        left, right = self._wheel_angles(steering)
        wheels = (math.cos(left), math.sin(left), math.cos(right), math.sin(right), duty, brake)
        h, half = self._step, 0.5 * self._step
        k1 = self._slopes(s, wheels, held)
        k2 = self._slopes([a + half * b for a, b in zip(s, k1)], wheels, held)  # noqa: B905
        k3 = self._slopes([a + half * b for a, b in zip(s, k2)], wheels, held)  # noqa: B905
        k4 = self._slopes([a + h * b for a, b in zip(s, k3)], wheels, held)  # noqa: B905
        sixth = h / 6.0
        after = [
            a + sixth * (b + 2.0 * (c + d) + e)
            for a, b, c, d, e in zip(s, k1, k2, k3, k4)  # noqa: B905
        ]
        return tuple(after)  # type: ignore[return-value]

    def _wheel_angles(self, steering: float) -> tuple[float, float]:
        """Angles of the left and right wheel for a mean angle: parallel at an Ackermann share of 0, concentric at 1."""
        p = self.parameters
        t = math.tan(steering)
        side = 0.5 * p.ackermann * p.track * t / p.wheelbase
        return math.atan(t / (1.0 - side)), math.atan(t / (1.0 + side))

    def _slopes(
        self, s: _Motion | list[float], wheels: tuple[float, float, float, float, float, float], held: bool
    ) -> _Motion:
        """Time derivatives of the 14 states of motion."""
        p = self.parameters
        _, _, yaw, u, v, r, roll, roll_rate, pitch, pitch_rate, s1, s2, s3, s4 = s
        cos_l, sin_l, cos_r, sin_r, duty, brake = wheels
        front, rear, half_track = self._to_front, self._to_rear, 0.5 * p.track

        roll_moment = self._roll_stiffness * roll + self._roll_damping * roll_rate
        pitch_moment = self._pitch_stiffness * pitch + self._pitch_damping * pitch_rate
        if held:
            push, side = 0.0, 0.0
            f1 = f2 = f3 = f4 = _REST[0]
            slopes = (0.0, 0.0, 0.0, 0.0)
            du = dv = dr = 0.0
        else:
            # Roll and pitch moments of the springs change the loads of the wheels.
            along = 0.5 * pitch_moment / p.wheelbase
            across_front = p.roll_front_share * roll_moment / p.track
            across_rear = (1.0 - p.roll_front_share) * roll_moment / p.track
            drive = p.stall_force * (max(duty - u / p.free_speed, 0.0) - brake * u / p.free_speed)
            front_drive = 0.5 * drive * p.drive_front_share
            rear_drive = 0.5 * drive - front_drive

            speed_front, speed_rear = v + front * r, v - rear * r
            u_left, u_right = u - half_track * r, u + half_track * r
            a1, f1, d1 = self._tyre(
                u_left * cos_l + speed_front * sin_l, speed_front * cos_l - u_left * sin_l, s1,
                self._front_load + along - across_front, self._front_load, p.front_stiffness, front_drive,
            )  # fmt: skip
            a2, f2, d2 = self._tyre(
                u_right * cos_r + speed_front * sin_r, speed_front * cos_r - u_right * sin_r, s2,
                self._front_load + along + across_front, self._front_load, p.front_stiffness, front_drive,
            )  # fmt: skip
            a3, f3, d3 = self._tyre(
                u_left, speed_rear, s3,
                self._rear_load - along - across_rear, self._rear_load, p.rear_stiffness, rear_drive,
            )  # fmt: skip
            a4, f4, d4 = self._tyre(
                u_right, speed_rear, s4,
                self._rear_load - along + across_rear, self._rear_load, p.rear_stiffness, rear_drive,
            )  # fmt: skip
            slopes = (d1, d2, d3, d4)
            x1, y1 = a1 * cos_l - f1 * sin_l, a1 * sin_l + f1 * cos_l
            x2, y2 = a2 * cos_r - f2 * sin_r, a2 * sin_r + f2 * cos_r
            du = (x1 + x2 + a3 + a4 + p.mass * v * r) / (p.mass + p.rotating_mass)
            dv = (y1 + y2 + f3 + f4) / p.mass - u * r
            dr = (front * (y1 + y2) - rear * (f3 + f4) + half_track * (x2 - x1 + a4 - a3)) / p.yaw_inertia
            push, side = du - v * r, dv + u * r

        arm = p.mass * p.centre_of_mass_height
        roll_slope = (arm * (side + GRAVITY * roll) - roll_moment) / p.roll_inertia
        pitch_slope = (arm * (GRAVITY * pitch - push) - pitch_moment) / p.pitch_inertia
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        return (
            u * cos_yaw - v * sin_yaw, u * sin_yaw + v * cos_yaw, r, du, dv, dr,
            roll_rate, roll_slope, pitch_rate, pitch_slope, *slopes,
        )  # fmt: skip

    def _tyre(
        self,
        along: float,
        across: float,
        slip: float,
        load: float,
        rated: float,
        stiffness: float,
        drive: float,
    ) -> tuple[float, float, float]:
        """Forces along and across a wheel (N) and rate of its slip (1/s), from its velocities along and across."""
        p = self.parameters
        rate = (across - abs(along) * slip) / p.relaxation_length
        if abs(slip) > MAX_SLIP and slip * rate > 0.0:
            rate = 0.0
        if load <= 0.0:
            return 0.0, 0.0, rate
        friction = p.friction * (1.0 - p.load_sensitivity * (load / rated - 1.0))
        grip = friction * load
        force = drive - p.rolling_resistance * load * along / math.sqrt(
            along * along + STANDSTILL_SPEED * STANDSTILL_SPEED
        )
        if not -grip <= force <= grip:  # rarely: faster than min and max
            force = min(max(force, -grip), grip)
        deflection = slip + p.carcass_damping * rate
        lateral = math.sin(p.shape * math.atan(stiffness / (p.shape * friction) * deflection))
        return force, -lateral * math.sqrt(grip * grip - force * force), rate


def rollout(
    parameters: DonkeyParameters, commands: ArrayLike, initial_state: CarState | None = None
) -> NDArray[np.float64]:
    """Simulate a sequence of commands; a pure function, suitable for least squares over the parameters.

    Args:
        parameters: parameters of the car.
        commands: (n, 2) steering in [-1, 1] and throttle in [0, 1], one row per step of 1/20 s. Neutral commands
            are assumed before the first one.
        initial_state: state at the start of the first step; at rest at the origin if omitted.

    Returns:
        (n + 1, 17) states, columns as in `CarState`; the first row is the initial state.

    Raises:
        ValueError: the commands are not (n, 2).
        ds_sim.simulator.CommandError: a command is not a number or is out of range.
    """
    rows = np.asarray(commands, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise ValueError(f"commands have shape {rows.shape}, expected (n, 2): steering and throttle per frame")
    model = CarModel(parameters)
    state = initial_state or CarState()
    pulses = [model.pulse(Command(0.0, 0.0))] * model.pulses_kept
    states = [state]
    for steering, throttle in rows.tolist():
        pulses.append(model.pulse(Command(steering, throttle)))
        state = model.advance(state, pulses)
        states.append(state)
    return np.array(states)
