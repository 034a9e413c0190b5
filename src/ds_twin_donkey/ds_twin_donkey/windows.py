# SPDX-License-Identifier: Apache-2.0
"""Cuts recorded drives into windows and simulates the car through each of them from its own initial state.

Servo, play and motor lag depend on the commands alone: they are simulated over the seconds before the window. The
position of the wheels within the play of the steering is unknown until the steering has moved, so it is part of the
initial state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ds_base.errors import InputError
from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.dynamics import MOTION, CarModel, CarState, pulse
from ds_twin_donkey.logs import CHANNELS, LogSegment
from ds_twin_donkey.parameters import DonkeyParameters

Array = NDArray[np.float64]
UNKNOWNS = 7
"""Unknowns of a window's initial state: x, y, yaw, speed, lateral speed, yaw rate, position within the play."""
RUN_IN = 5
"""Frames before a window's first residual; by then tyres and body (5 Hz, damped) have forgotten their start."""
_SETTLING = 30
"""Frames of commands simulated before that; twelve time constants of the motor lag, the slowest actuator."""
_INITIAL_SPREAD = np.array([np.inf, np.inf, np.inf, 0.1, np.nan, 0.3, 3.0**-0.5])
"""Standard deviation of an initial state about its smoothed measurement (m/s, m/s, rad/s; 1); chosen: three to five
times what smoothing leaves of typical noise; for the lateral speed see `_LIKELY_SLIP`. The last one is that of a
uniform distribution between -1 and 1."""
_LIKELY_SLIP = 0.1
"""Standard deviation of the initial lateral speed over the speed; chosen: that of a hard bend. It matters only where a
window forgets the value before its first residual; a larger one would destabilise slow cars, which forget fastest."""
_STANDING_SPEED, _ROLLING_SPEED = 0.03, 0.15
"""Speeds between which no window begins, model m/s, because noise decides whether friction holds the car there. A
slower car counts as standing if no throttle is pending. Chosen: smoothed noise of a speed sensor, and a few frames of
acceleration from rest."""
_STANDING_FRAMES = 10
"""Frames for which a car must have stood; chosen: in half a second a rolling car loses more than `_STANDING_SPEED`."""
_STANDING_SPREAD = 1e-4
"""Standard deviation of a standing car's initial state, m/s and rad/s."""
_MIN_SLIP_SPEED = 0.1
"""Speed below which a window starts without slip, m/s, because slip is relative to speed."""


class FitError(InputError):
    """No parameters can be fitted to the drives."""


class Windows:
    """Consecutive windows of drives, some seconds long; the last one of a drive may be shorter, down to a third.

    Of the car, what is not fitted is used: wheelbase and masses. If all windows are longer than `max_total`, s, evenly
    spaced ones are kept; `max_delay` is the longest delay of a command, s. FitError if no drive is long enough.

    Attributes:
        count: number of windows.
        measured: (windows, frames, 5) measurements, columns as `logs.CHANNELS`; NaN where nothing was measured.
        known: mask of the measured values, same shape.
        initial_states: (windows, `UNKNOWNS`) smoothed measurements at the first frame.
        initial_spread: (windows, `UNKNOWNS`) standard deviations of `initial_states`.
    """

    def __init__(
        self, drives: Sequence[LogSegment], car: DonkeyParameters, seconds: float, max_total: float, max_delay: float
    ) -> None:
        self._car = car
        self._length = round(seconds / FRAME_TIME)
        self._shortest = math.ceil(self._length / 3)
        self._before = _SETTLING + math.ceil(max_delay / FRAME_TIME) + 2
        places = [(drive, begin) for drive in drives for begin in self._begins(drive)]
        if not places:
            before = 0 if any(drive.from_rest for drive in drives) else self._before
            need = (RUN_IN + self._shortest + before) * FRAME_TIME
            raise FitError(f"no drive lasts {need:g} s without a gap: record longer ones, or use shorter windows")
        max_count = max(int(max_total / seconds), 1)
        if len(places) > max_count:
            places = [places[i] for i in np.linspace(0, len(places) - 1, max_count).round().astype(int)]
        self.count = len(places)
        frames = self._before + RUN_IN + self._length
        self._commands = np.zeros((self.count, frames, 2))
        self.measured = np.full((self.count, self._length, len(CHANNELS)), np.nan)
        self.initial_states = np.zeros((self.count, UNKNOWNS))
        self.initial_spread = np.tile(_INITIAL_SPREAD, (self.count, 1))
        rear = car.wheelbase * car.front_share
        for window, (drive, begin) in enumerate(places):
            commands = np.concatenate((np.zeros((self._before, 2)), drive.commands))[begin : begin + frames]
            rows = drive.measured[begin + RUN_IN : begin + RUN_IN + self._length]
            self._commands[window, : len(commands)] = commands
            self.measured[window, : len(rows)] = rows
            self.initial_states[window, :6] = _state_at(drive.measured, begin, rear)
            if self.initial_states[window, 3] < _STANDING_SPEED:
                self.initial_states[window, 3:] = 0.0
                self.initial_spread[window, 3:6] = _STANDING_SPREAD
            else:
                self.initial_spread[window, 4] = _LIKELY_SLIP * max(self.initial_states[window, 3], _ROLLING_SPEED)
        self.known = np.isfinite(self.measured)

    def _begins(self, drive: LogSegment) -> list[int]:
        """Rows of a drive at which its windows begin."""
        begins, at = [], RUN_IN if drive.from_rest else RUN_IN + self._before
        while at + self._shortest <= len(drive.commands):
            if self._can_begin(drive, at - RUN_IN) and np.isfinite(drive.measured[at : at + self._length]).any():
                begins.append(at - RUN_IN)
                at += self._length
            else:
                at += 1
        return begins

    def _can_begin(self, drive: LogSegment, row: int) -> bool:
        """True if the car is rolling, or stands and no throttle is pending."""
        speed = float(_state_at(drive.measured, row, 0.0)[3])
        if speed >= _ROLLING_SPEED:
            return True
        throttle = drive.commands[max(row - self._before + _SETTLING, 0) : row, 1]
        before = float(_state_at(drive.measured, row - _STANDING_FRAMES, 0.0)[3]) if row >= _STANDING_FRAMES else 0.0
        return max(speed, before) < _STANDING_SPEED and bool((throttle <= self._car.throttle_dead_band).all())

    def predict(self, cars: Sequence[DonkeyParameters], states: Array, substeps: int) -> Array:
        """Simulate every window from its initial state: (cars, windows, 7) -> (cars, windows, frames, 5)."""
        kept = np.empty((len(cars), self.count, self._length, 6))
        for car, first, paths in zip(cars, states, kept, strict=True):
            model = CarModel(car, substeps=substeps)
            at = self._before - model.frames_kept + 1
            starts = self._starts(model, first, self._commands[:, at - _SETTLING : self._before])
            for start, commands, path in zip(starts, self._commands[:, at:], paths, strict=True):
                path[:] = model.run(start, commands[:-1])[RUN_IN:, :6]
        x, y, yaw, speed, _, rate = np.moveaxis(kept, -1, 0)
        ahead = self._car.wheelbase * (self._car.front_share - 0.5)
        return np.stack((x - ahead * np.cos(yaw), y - ahead * np.sin(yaw), yaw, speed, rate), axis=-1)

    def _starts(self, model: CarModel, first: Array, commands: Array) -> Array:
        """States in which the windows start, (windows, 17), from initial states, (windows, `UNKNOWNS`).

        The wheels are between where they end up after starting at either end of the play. The path is a smooth function
        of that final position, but not of the initial one, which is forgotten once the steering moves.
        """
        half = 0.5 * model.parameters.servo_backlash
        starts = np.zeros((self.count, len(CarState._fields)))
        for start, of_window, play in zip(starts, commands, first[:, -1], strict=True):
            angle, duty, _ = pulse(model.parameters, *of_window[0])
            ends = [CarState(servo=angle, steering_angle=angle + side, duty=duty) for side in (-half, half)]
            low, high = (model.run(end, of_window)[-1, MOTION:] for end in ends)
            start[MOTION:] = 0.5 * ((1.0 - play) * low + (1.0 + play) * high)
        starts[:, :6] = first[:, :6]
        _set_steady_state(starts.T, starts[:, MOTION + 1], self._car)
        return starts

    def difference(self, predicted: Array) -> Array:
        """Model minus measurement; 0 where nothing was measured."""
        return np.where(self.known, predicted - np.nan_to_num(self.measured), 0.0)

    def noise(self) -> Array:
        """(5,) standard deviation of white noise per channel, from third differences (20 times its variance)."""
        differences = np.abs(np.diff(self.measured, n=3, axis=1)).reshape(-1, len(CHANNELS))
        sizes = np.zeros(len(CHANNELS))
        for channel, column in enumerate(differences.T):
            recorded = column[np.isfinite(column)]
            if recorded.size:
                # Robust against the car's motion: the median absolute value of a normal distribution is 0.6745 sigma.
                sizes[channel] = np.median(recorded) / 0.6745 / math.sqrt(20.0)
        return sizes


def _state_at(measured: Array, at: int, rear: float) -> Array:
    """Smoothed state at a row: a parabola fitted to each channel over nine rows, assuming no slip of the rear tyres."""
    span = slice(max(at - 4, 0), at + 5)
    time = (np.arange(len(measured))[span] - at) * FRAME_TIME
    value, slope, bend = np.full(5, np.nan), np.full(5, np.nan), np.full(5, np.nan)
    for channel in range(5):
        rows = measured[span, channel]
        recorded = np.isfinite(rows)
        if recorded.sum() >= 4:
            bend[channel], slope[channel], value[channel] = np.polyfit(time[recorded], rows[recorded], 2)
    x, y, yaw, speed, rate = value
    pace = math.hypot(slope[0], slope[1])
    speed = pace if math.isnan(speed) else speed
    if math.isnan(rate):
        turning = (slope[0] * 2.0 * bend[1] - slope[1] * 2.0 * bend[0]) / max(pace, 0.1) ** 2
        rate = slope[2] if math.isfinite(slope[2]) else turning if pace > 0.1 else 0.0
    if math.isnan(yaw):
        yaw = math.atan2(slope[1], slope[0]) - math.atan2(rear * rate, max(pace, 0.1))
    return np.nan_to_num(np.array([x, y, yaw, max(float(np.nan_to_num(speed)), 0.0), rear * rate, rate]))


def _set_steady_state(motion: Array, wheels: Array, p: DonkeyParameters) -> None:
    """Set slip and roll in `motion` to the steady state for the given speeds and wheel angles."""
    u, v, r = motion[3:6]
    moving = u > _MIN_SLIP_SPEED
    pace = np.where(moving, u, 1.0)
    front = (v + p.wheelbase * (1.0 - p.front_share) * r) / pace - np.tan(wheels)
    rear = (v - p.wheelbase * p.front_share * r) / pace
    motion[10] = motion[11] = np.where(moving, np.clip(front, -0.5, 0.5), 0.0)
    motion[12] = motion[13] = np.where(moving, np.clip(rear, -0.5, 0.5), 0.0)
    arm = p.mass * p.centre_of_mass_height
    motion[6] = arm * u * r / (p.roll_inertia * (math.tau * p.roll_frequency) ** 2)
