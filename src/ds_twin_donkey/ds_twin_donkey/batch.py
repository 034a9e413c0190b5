# SPDX-License-Identifier: Apache-2.0
"""Vectorised version of `dynamics`: the same equations for many lanes at once, for least squares.

A lane is one window of a recorded drive with one set of parameters. A Jacobian over a one-minute drive takes about a
second this way and half a minute lane by lane. A test compares the results with `dynamics.rollout`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.dynamics import MAX_SLIP, STANDSTILL_SPEED, SUBSTEPS
from ds_twin_donkey.parameters import GRAVITY, DonkeyParameters

Array = NDArray[np.float64]


class Lanes:
    """Simulates one car per lane.

    Args:
        parameters: parameter sets.
        which: (n,) index of the parameter set of each lane.
        substeps: substeps per step; fewer are faster and less accurate.
    """

    def __init__(
        self, parameters: Sequence[DonkeyParameters], which: NDArray[np.int64], substeps: int = SUBSTEPS
    ) -> None:
        self._step = step = FRAME_TIME / substeps
        names = [field.name for field in dataclasses.fields(DonkeyParameters)]
        table = {name: np.array([getattr(p, name) for p in parameters], dtype=np.float64)[which] for name in names}
        self._p = table
        p, rows = table, np.stack
        self._to_front = p["wheelbase"] * (1.0 - p["front_share"])
        self._to_rear = p["wheelbase"] * p["front_share"]
        weight = p["mass"] * GRAVITY
        front, rear = 0.5 * weight * p["front_share"], 0.5 * weight * (1.0 - p["front_share"])
        self._static = rows((front, front, rear, rear))
        roll, pitch = math.tau * p["roll_frequency"], math.tau * p["pitch_frequency"]
        lean = weight * p["centre_of_mass_height"]
        self._roll_damping = 2.0 * p["body_damping"] * p["roll_inertia"] * roll
        self._pitch_damping = 2.0 * p["body_damping"] * p["pitch_inertia"] * pitch
        self._roll_stiffness = p["roll_inertia"] * roll**2 + lean
        self._pitch_stiffness = p["pitch_inertia"] * pitch**2 + lean
        self._breakaway = p["rolling_resistance"] * weight
        self._motor_gain = -np.expm1(-step / p["motor_lag"])
        self._frames_of_delay = np.floor_divide(p["command_delay"], FRAME_TIME).astype(np.int64)
        rest = p["command_delay"] - self._frames_of_delay * FRAME_TIME
        ends = (np.arange(substeps) + 1.0) * step
        newer = np.clip((ends[:, None] - rest) / step, 0.0, 1.0)
        # Per substep: share of the newer pulse, and gain and largest move of the servo under either pulse.
        parts = [
            (-np.expm1(-part * step / p["servo_lag"]), part * step * p["servo_rate"]) for part in (1.0 - newer, newer)
        ]
        self._shares = np.stack((newer, *parts[0], *parts[1]), axis=1)
        # Constants of the four tyres, rows front left, front right, rear left, rear right.
        stiffness = rows((p["front_stiffness"], p["front_stiffness"], p["rear_stiffness"], p["rear_stiffness"]))
        self._curve = stiffness / (p["shape"] * p["friction"])
        self._roll_load = rows(
            (-p["roll_front_share"], p["roll_front_share"], p["roll_front_share"] - 1.0, 1.0 - p["roll_front_share"])
        ) / p["track"]  # fmt: skip
        along = 0.5 / p["wheelbase"]
        self._pitch_load = rows((along, along, -along, -along))
        share = p["drive_front_share"]
        self._drive_share = 0.5 * rows((share, share, 1.0 - share, 1.0 - share))

    @property
    def history(self) -> int:
        """Number of frames before the first one whose pulses are read because of the longest delay."""
        return int(self._frames_of_delay.max()) + 1

    def pulses(self, commands: Array) -> Array:
        """Convert commands (frames, n, 2) to pulses (frames, 3, n): angle (rad), duty, brake; see `CarModel.pulse`."""
        p = self._p
        steering = np.round(commands[:, :, 0] * p["steering_pulse_steps"]) / p["steering_pulse_steps"]
        throttle = np.round(commands[:, :, 1] * p["throttle_pulse_steps"]) / p["throttle_pulse_steps"]
        above = (throttle - p["throttle_dead_band"]) / (1.0 - p["throttle_dead_band"])
        driven = above >= 0.0
        duty = np.where(driven, p["start_duty"] + (p["full_duty"] - p["start_duty"]) * above, 0.0)
        angle = p["steering_trim"] - steering * p["max_steering_angle"]
        return np.stack((angle, duty, np.where(driven, 0.0, p["drag_brake"])), axis=1)

    def delayed(self, pulses: Array, frame: int) -> tuple[Array, Array]:
        """Older and newer pulse that are effective during a step, each (3, n)."""
        at = frame - self._frames_of_delay
        lane = np.arange(len(at))
        return pulses[at - 1, :, lane].T, pulses[at, :, lane].T

    def settle(self, pulses: Array, frames: range, play: Array) -> tuple[Array, Array, Array]:
        """Servo (rad), wheels (rad) and duty after some frames, starting from the steady state of the first pulse.

        Args:
            pulses: pulses as returned by `pulses`.
            frames: indices of the pulses to apply.
            play: (n,) final position of the wheels within the play, -1 to 1. The end points are where the wheels end up
                after starting at either end of the play. The path is a smooth function of the final position, but not
                of the initial one, which is forgotten once the steering moves.
        """
        older, _ = self.delayed(pulses, frames[0])
        servo, duty = older[0].copy(), older[1].copy()
        half = 0.5 * self._p["servo_backlash"]
        wheels = np.stack((servo - half, servo + half))
        for frame in frames:
            older, newer = self.delayed(pulses, frame)
            for share in self._shares:
                servo, wheels, _, duty, _, _ = self._actuate(servo, wheels, duty, older, newer, share)
        return servo, 0.5 * ((1.0 - play) * wheels[0] + (1.0 + play) * wheels[1]), duty

    def advance(
        self, motion: Array, actuators: tuple[Array, Array, Array], older: Array, newer: Array
    ) -> tuple[Array, tuple[Array, Array, Array]]:
        """Advance by one step; returns motion, (14, n), and the three actuator states."""
        servo, wheels, duty = actuators
        for share in self._shares:
            servo, wheels, before, duty, middle, brake = self._actuate(servo, wheels, duty, older, newer, share)
            motion = self._move(motion, 0.5 * (before + wheels), middle, brake)
        return motion, (servo, wheels, duty)

    def _actuate(
        self, servo: Array, wheels: Array, duty: Array, older: Array, newer: Array, share: Array
    ) -> tuple[Array, Array, Array, Array, Array, Array]:
        part, older_gain, older_reach, newer_gain, newer_reach = share
        _, wanted, brake = part * newer + (1.0 - part) * older
        play = 0.5 * self._p["servo_backlash"]
        servo = servo + np.minimum(np.maximum((older[0] - servo) * older_gain, -older_reach), older_reach)
        servo = servo + np.minimum(np.maximum((newer[0] - servo) * newer_gain, -newer_reach), newer_reach)
        before = wheels
        wheels = np.minimum(np.maximum(wheels, servo - play), servo + play)
        change = (wanted - duty) * self._motor_gain
        return servo, wheels, before, duty + change, duty + 0.5 * change, brake

    def _move(self, s: Array, steering: Array, duty: Array, brake: Array) -> Array:
        p = self._p
        slow = (
            (np.abs(s[3]) < STANDSTILL_SPEED)
            & (np.abs(s[4]) < STANDSTILL_SPEED)
            & (np.abs(s[5]) * p["wheelbase"] < STANDSTILL_SPEED)
        )
        held = slow & (p["stall_force"] * duty <= self._breakaway)
        free = (~held).astype(np.float64)
        if held.any():
            s = s.copy()
            s[3:6] *= free
            s[10:] *= free
        tangent = np.tan(steering)
        side = 0.5 * p["ackermann"] * p["track"] * tangent / p["wheelbase"]
        tangents = np.stack((tangent / (1.0 - side), tangent / (1.0 + side)))
        cosines = 1.0 / np.sqrt(1.0 + tangents * tangents)
        wheels = (cosines, tangents * cosines, duty, brake, free)
        h = self._step
        k1 = self._slopes(s, wheels)
        k2 = self._slopes(s + 0.5 * h * k1, wheels)
        k3 = self._slopes(s + 0.5 * h * k2, wheels)
        k4 = self._slopes(s + h * k3, wheels)
        after: Array = s + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        return after

    def _slopes(self, s: Array, wheels: tuple[Array, Array, Array, Array, Array]) -> Array:
        p = self._p
        yaw, u, v, r, roll, roll_rate, pitch, pitch_rate = s[2:10]
        slip = s[10:14]
        cosines, sines, duty, brake, free = wheels
        roll_moment = self._roll_stiffness * roll + self._roll_damping * roll_rate
        pitch_moment = self._pitch_stiffness * pitch + self._pitch_damping * pitch_rate
        load = np.maximum(self._static + self._pitch_load * pitch_moment + self._roll_load * roll_moment, 0.0)

        pace = u / p["free_speed"]
        drive = p["stall_force"] * (np.maximum(duty - pace, 0.0) - brake * pace)
        half_track = 0.5 * p["track"]
        along, across = np.empty_like(slip), np.empty_like(slip)
        along[2], along[3] = u - half_track * r, u + half_track * r
        across[2] = across[3] = v - self._to_rear * r
        speed_front = v + self._to_front * r
        along[:2] = along[2:] * cosines + speed_front * sines
        across[:2] = speed_front * cosines - along[2:] * sines

        rate = (across - np.abs(along) * slip) / p["relaxation_length"]
        rate[(np.abs(slip) > MAX_SLIP) & (slip * rate > 0.0)] = 0.0
        friction = p["friction"] * (1.0 - p["load_sensitivity"] * (load / self._static - 1.0))
        grip = friction * load
        force = drive * self._drive_share - p["rolling_resistance"] * load * along / np.sqrt(
            along * along + STANDSTILL_SPEED**2
        )
        force = np.minimum(np.maximum(force, -grip), grip)
        deflection = slip + p["carcass_damping"] * rate
        # The scalar model divides by the friction under this load; `_curve` contains all of it but the load dependence.
        bend = np.arctan(self._curve * (p["friction"] / friction) * deflection)
        lateral = -np.sin(p["shape"] * bend) * np.sqrt(np.maximum(grip * grip - force * force, 0.0))

        x_front = force[:2] * cosines - lateral[:2] * sines
        y_front = force[:2] * sines + lateral[:2] * cosines
        ahead = x_front[0] + x_front[1] + force[2] + force[3]
        front, rear = y_front[0] + y_front[1], lateral[2] + lateral[3]
        mass = p["mass"]
        du = free * (ahead + mass * v * r) / (mass + p["rotating_mass"])
        dv = free * ((front + rear) / mass - u * r)
        turn = half_track * (x_front[1] - x_front[0] + force[3] - force[2])
        dr = free * (self._to_front * front - self._to_rear * rear + turn) / p["yaw_inertia"]
        push, side = du - v * r, dv + u * r
        arm = mass * p["centre_of_mass_height"]
        slopes = np.empty_like(s)
        cos_yaw, sin_yaw = np.cos(yaw), np.sin(yaw)
        slopes[0], slopes[1], slopes[2] = u * cos_yaw - v * sin_yaw, u * sin_yaw + v * cos_yaw, r
        slopes[3], slopes[4], slopes[5] = du, dv, dr
        slopes[6], slopes[8] = roll_rate, pitch_rate
        slopes[7] = (arm * (side + GRAVITY * roll) - roll_moment) / p["roll_inertia"]
        slopes[9] = (arm * (GRAVITY * pitch - push) - pitch_moment) / p["pitch_inertia"]
        slopes[10:14] = rate * free
        return slopes
