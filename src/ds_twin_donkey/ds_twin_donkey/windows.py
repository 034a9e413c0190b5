"""Recorded drives cut into windows, and the car rolled out through each of them from a first state of its own.

Servo, play and motor lag follow from the commands alone: they are run in over the seconds before the window. Where in
the play of the steering the wheels are is known only once the steering has moved, so that is part of the first state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.batch import MOTION, Lanes
from ds_twin_donkey.logs import CHANNELS, Drive
from ds_twin_donkey.parameters import DonkeyParameters

Array = NDArray[np.float64]
UNKNOWNS = 7
"""Of a window's first state: x, y, yaw, speed, lateral speed, yaw rate, and place in the play of the steering."""
RUN_IN = 5
"""Frames before a window's first residual; tyres and body (5 Hz, damped) have forgotten how they were set by then."""
_SETTLING = 30
"""Frames of commands before that; twelve time constants of the motor's lag, the slowest actuator."""
_GUESS = np.array([np.inf, np.inf, np.inf, 0.1, np.nan, 0.3, 3.0**-0.5])
"""How far a first state may be off its smoothed measurement (m/s, m/s, rad/s; 1); chosen: three to five times what the
smoothing leaves of usual noise; for the lateral speed see `_LIKELY_SLIP`. The last one is the spread of any place
between -1 and 1."""
_LIKELY_SLIP = 0.1
"""What a first lateral speed may be off, over the speed; chosen: a hard bend's. It matters only where a window forgets
it before its first residual, and a slow car, which forgets fastest, would be flung about by more."""
_STANDS, _ROLLS = 0.03, 0.15
"""Model m/s. No window begins between them: whether friction holds the car there is a matter of noise. A slower car is
taken to stand if no throttle is on its way. Chosen: smoothed noise of a speed sensor, and a few frames of
getting under way."""
_STOOD = 10
"""Frames that a car must have stood for; chosen: in half a second a rolling one loses more than `_STANDS`."""
_REST = 1e-4
"""m/s, rad/s; what a standing car's first state may be off."""
_FASTEST_INITIAL_SLIP = 0.1
"""m/s; below this a window starts without slip, for slip is a ratio to the speed."""


class FitError(ValueError):
    """Drives to which nothing can be fitted."""


class Windows:
    """Windows of drives, end to end; the last of a drive may be shorter, down to a third.

    Args:
        drives: recorded.
        car: its wheelbase and masses, which are not fitted.
        seconds: length of a window.
        longest: of all windows together, s; more are thinned out evenly.
        longest_delay: of a command, s.

    Attributes:
        count: how many windows.
        measured: (windows, frames, 5) columns as `logs.CHANNELS`; NaN where nothing was measured.
        known: the same shape, where something was.
        first_states: (windows, `UNKNOWNS`) smoothed measurements at the first frame.
        guess: the same shape, how far off each may be.

    Raises:
        FitError: no drive is long enough.
    """

    def __init__(
        self, drives: Sequence[Drive], car: DonkeyParameters, seconds: float, longest: float, longest_delay: float
    ) -> None:
        self._car = car
        self._length = round(seconds / FRAME_TIME)
        self._shortest = math.ceil(self._length / 3)
        self._before = _SETTLING + math.ceil(longest_delay / FRAME_TIME) + 2
        places = [(drive, begin) for drive in drives for begin in self._begins(drive)]
        if not places:
            before = 0 if any(drive.from_rest for drive in drives) else self._before
            need = (RUN_IN + self._shortest + before) * FRAME_TIME
            raise FitError(f"no drive of {need:g} s without a gap: record longer ones, or take shorter windows")
        most = max(int(longest / seconds), 1)
        if len(places) > most:
            places = [places[i] for i in np.linspace(0, len(places) - 1, most).round().astype(int)]
        self.count = len(places)
        frames = self._before + RUN_IN + self._length
        self._commands = np.zeros((frames, self.count, 2))
        self.measured = np.full((self.count, self._length, len(CHANNELS)), np.nan)
        self.first_states = np.zeros((self.count, UNKNOWNS))
        self.guess = np.tile(_GUESS, (self.count, 1))
        rear = car.wheelbase * car.front_share
        for window, (drive, begin) in enumerate(places):
            told = np.concatenate((np.zeros((self._before, 2)), drive.commands))[begin : begin + frames]
            rows = drive.measured[begin + RUN_IN : begin + RUN_IN + self._length]
            self._commands[: len(told), window] = told
            self.measured[window, : len(rows)] = rows
            self.first_states[window, :6] = _state_at(drive.measured, begin, rear)
            if self.first_states[window, 3] < _STANDS:
                self.first_states[window, 3:] = 0.0
                self.guess[window, 3:6] = _REST
            else:
                self.guess[window, 4] = _LIKELY_SLIP * max(self.first_states[window, 3], _ROLLS)
        self.known = np.isfinite(self.measured)

    def _begins(self, drive: Drive) -> list[int]:
        """Rows at which windows of a drive begin."""
        begins, at = [], RUN_IN if drive.from_rest else RUN_IN + self._before
        while at + self._shortest <= len(drive.commands):
            if self._can_begin(drive, at - RUN_IN) and np.isfinite(drive.measured[at : at + self._length]).any():
                begins.append(at - RUN_IN)
                at += self._length
            else:
                at += 1
        return begins

    def _can_begin(self, drive: Drive, row: int) -> bool:
        """Whether the car rolls, or has come to rest and has not been told to go."""
        speed = float(_state_at(drive.measured, row, 0.0)[3])
        if speed >= _ROLLS:
            return True
        told = drive.commands[max(row - self._before + _SETTLING, 0) : row, 1]
        before = float(_state_at(drive.measured, row - _STOOD, 0.0)[3]) if row >= _STOOD else 0.0
        return max(speed, before) < _STANDS and bool((told <= self._car.throttle_dead_band).all())

    def predict(self, cars: Sequence[DonkeyParameters], states: Array, substeps: int) -> Array:
        """Roll out every window from its first state: (cars, windows, 7) -> (cars, windows, frames, 5)."""
        sets = len(cars)
        lanes = Lanes(cars, np.repeat(np.arange(sets), self.count), substeps)
        pulses = lanes.pulses(np.tile(self._commands, (1, sets, 1)))
        first = states.reshape(-1, UNKNOWNS).T
        actuators = lanes.settle(pulses, range(self._before - _SETTLING, self._before), first[6])
        motion = np.zeros((MOTION, sets * self.count))
        motion[:6] = first[:6]
        _lean(motion, actuators[1], self._car)
        kept = np.empty((self._length, 6, sets * self.count))
        for frame in range(RUN_IN + self._length):
            if frame >= RUN_IN:
                kept[frame - RUN_IN] = motion[:6]
            if frame < RUN_IN + self._length - 1:
                motion, actuators = lanes.advance(motion, actuators, *lanes.delayed(pulses, self._before + frame))
        x, y, yaw, speed, _, rate = np.moveaxis(kept, 1, 0)
        ahead = self._car.wheelbase * (self._car.front_share - 0.5)
        rows = np.stack((x - ahead * np.cos(yaw), y - ahead * np.sin(yaw), yaw, speed, rate), axis=-1)
        return rows.reshape(self._length, sets, self.count, len(CHANNELS)).transpose(1, 2, 0, 3)

    def difference(self, predicted: Array) -> Array:
        """Model less measurement; 0 where nothing was measured."""
        return np.where(self.known, predicted - np.nan_to_num(self.measured), 0.0)

    def noise(self) -> Array:
        """(5,) white noise per channel from third differences, whose variance is 20 times that of the noise."""
        differences = np.abs(np.diff(self.measured, n=3, axis=1)).reshape(-1, len(CHANNELS))
        sizes = np.zeros(len(CHANNELS))
        for channel, column in enumerate(differences.T):
            known = column[np.isfinite(column)]
            if known.size:
                # Median of a normal's size is 0.6745 of its spread: robust against what the car itself does.
                sizes[channel] = np.median(known) / 0.6745 / math.sqrt(20.0)
        return sizes


def _state_at(measured: Array, at: int, rear: float) -> Array:
    """A smooth state at a row: a parabola through each channel over nine rows; rear tyres without slip."""
    span = slice(max(at - 4, 0), at + 5)
    time = (np.arange(len(measured))[span] - at) * FRAME_TIME
    value, slope, bend = np.full(5, np.nan), np.full(5, np.nan), np.full(5, np.nan)
    for channel in range(5):
        rows = measured[span, channel]
        known = np.isfinite(rows)
        if known.sum() >= 4:
            bend[channel], slope[channel], value[channel] = np.polyfit(time[known], rows[known], 2)
    x, y, yaw, speed, rate = value
    pace = math.hypot(slope[0], slope[1])
    speed = pace if math.isnan(speed) else speed
    if math.isnan(rate):
        turning = (slope[0] * 2.0 * bend[1] - slope[1] * 2.0 * bend[0]) / max(pace, 0.1) ** 2
        rate = slope[2] if math.isfinite(slope[2]) else turning if pace > 0.1 else 0.0
    if math.isnan(yaw):
        yaw = math.atan2(slope[1], slope[0]) - math.atan2(rear * rate, max(pace, 0.1))
    return np.nan_to_num(np.array([x, y, yaw, max(float(np.nan_to_num(speed)), 0.0), rear * rate, rate]))


def _lean(motion: Array, wheels: Array, p: DonkeyParameters) -> None:
    """Slip and roll of a car that has been going like this for a while."""
    u, v, r = motion[3:6]
    moving = u > _FASTEST_INITIAL_SLIP
    pace = np.where(moving, u, 1.0)
    front = (v + p.wheelbase * (1.0 - p.front_share) * r) / pace - np.tan(wheels)
    rear = (v - p.wheelbase * p.front_share * r) / pace
    motion[10] = motion[11] = np.where(moving, np.clip(front, -0.5, 0.5), 0.0)
    motion[12] = motion[13] = np.where(moving, np.clip(rear, -0.5, 0.5), 0.0)
    arm = p.mass * p.centre_of_mass_height
    motion[6] = arm * u * r / (p.roll_inertia * (math.tau * p.roll_frequency) ** 2)
