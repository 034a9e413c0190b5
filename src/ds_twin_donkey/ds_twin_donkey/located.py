# SPDX-License-Identifier: Apache-2.0
"""Before a fit to a recording that `ds recording locate` has located: where its camera sits, and what start is near.

Such poses are smoothed over some images, so servo, play and tyres cannot be separated from a delay, nor parts of the
motor from each other: `LOCATED` holds them. And they are those of the point below the camera, as the camera looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ds_base.progress import SILENT, Progress
from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.fit import ROUGH_SUBSTEPS, ROUGH_TOTAL, FitSettings, TwinFit, fit
from ds_twin_donkey.logs import LogSegment
from ds_twin_donkey.parameters import GRAVITY, DonkeyParameters
from ds_twin_donkey.windows import Windows

Array = NDArray[np.float64]
LOCATED = FitSettings(window_seconds=2.0, names=("max_steering_angle", "steering_trim", "command_delay", "full_duty"))
"""Settings of the fit. Chosen: no model follows a car on a real floor for 10 s, as what pushes it aside adds up."""
LOCKS, DELAYS = (0.5, 0.7, 1.0, 1.4), (0.03, 0.06, 0.12, 0.24)
"""Factors on the lock, and delays (s), of which the best start is taken; chosen: a fit reaches the next from each."""
ROLLING = 0.1
"""Speed from which a car says how it drives, m/s."""
SPAN = 10
"""Steps over which the poses' motion is compared with the car's; chosen: half a second, in which a car turns by more
than its heading is uncertain."""


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """Where the poses of a recording are, seen from the car."""

    forward: float = 0.0  # distance of the poses' point ahead of the car's centre, m
    yaw: float = 0.0  # direction of the poses, left of the car's, rad

    def to_car(self, poses: Array) -> Array:
        """Convert x, y and yaw of the poses' point, in the first columns of (..., n), to those of the car's centre."""
        return self._moved(poses, -self.forward, -self.yaw, 0.0)

    def to_pose(self, car: Array) -> Array:
        """Convert x, y and yaw of the car's centre to those of the poses' point."""
        return self._moved(car, self.forward, 0.0, self.yaw)

    @staticmethod
    def _moved(rows: Array, ahead: float, before: float, after: float) -> Array:
        moved = rows.copy()
        yaw = rows[..., 2] + before
        moved[..., 0] += ahead * np.cos(yaw)
        moved[..., 1] += ahead * np.sin(yaw)
        moved[..., 2] = yaw + after
        return moved

    def centred(self, drives: Sequence[LogSegment]) -> list[LogSegment]:
        """Drives of the car's centre."""
        return [replace(drive, measured=self.to_car(drive.measured)) for drive in drives]


def find_mounting(drives: Sequence[LogSegment], car: DonkeyParameters) -> Mounting:
    """Find how far ahead of the car's centre the poses are, and how they are turned, from how they slide sideways.

    In a bend the centre moves sideways by turn * (distance from the rear axle - speed^2 / (g * rear stiffness)), as in
    the single-track model with little slip; a point ahead moves by turn * distance more, and a heading that is turned
    to the left shows way * angle less. Robust least squares over half a second, as errors of single rows would hide the
    turn: rows that do not fit are left out. The mounting is that of the centre itself if no drive has five rows.
    """
    sums = [np.zeros((0, 3))]
    for drive in drives:
        if len(drive.measured) > SPAN:
            (x, y, turn), yaw = np.diff(drive.measured[:, :3], axis=0).T, drive.measured[:, 2]
            heading = 0.5 * (yaw[1:] + yaw[:-1])
            ahead, left = np.cos(heading) * x + np.sin(heading) * y, np.cos(heading) * y - np.sin(heading) * x
            slip = (ahead / FRAME_TIME) ** 2 / (GRAVITY * car.rear_stiffness)
            steps = ahead, left - turn * (car.wheelbase * car.front_share - slip), turn
            sums.append(np.column_stack([np.convolve(step, np.ones(SPAN), "valid") for step in steps]))
    rows = np.concatenate(sums)
    way, value, turn = rows[np.isfinite(rows).all(axis=1) & (rows[:, 0] > ROLLING * SPAN * FRAME_TIME)].T
    slopes, kept, solution = np.column_stack((turn, -way)), np.ones(len(value), dtype=bool), np.zeros(2)
    for _ in range(5):
        if kept.sum() < SPAN:
            return Mounting()
        solution = np.linalg.lstsq(slopes[kept], value[kept], rcond=None)[0]
        error = np.abs(value - slopes @ solution)
        kept = error <= 3.0 * 1.4826 * np.median(error) + 1e-9
    return Mounting(forward=float(solution[0]), yaw=float(solution[1]))


def rough_start(drives: Sequence[LogSegment], start: DonkeyParameters) -> DonkeyParameters:
    """Move a start to where a car of unknown gearing, lock and delay can be found from, as a fit stays near its start.

    Both duties are scaled to what the drives' speeds need in the median; of `LOCKS` and `DELAYS` those are taken whose
    headings follow the drives best over one second. FitError if no drive is long enough.
    """
    windows = Windows(drives, start, 1.0, ROUGH_TOTAL, max(DELAYS))
    rows = np.concatenate([np.column_stack((drive.commands[:, 1], drive.measured[:, 3])) for drive in drives])
    above = (rows[:, 0] - start.throttle_dead_band) / (1.0 - start.throttle_dead_band)
    driven = (above > 0.0) & (rows[:, 1] > ROLLING)
    if driven.any():
        resistance = start.rolling_resistance * start.mass * GRAVITY / start.stall_force
        needed = np.median(rows[driven, 1]) / start.free_speed + resistance
        has = start.start_duty + (start.full_duty - start.start_duty) * np.median(above[driven])
        factor = min(float(needed / has), 0.98 / start.full_duty)
        start = start.changed(start_duty=start.start_duty * factor, full_duty=start.full_duty * factor)
    locks = [min(start.max_steering_angle * factor, 1.15) for factor in LOCKS]
    cars = [start.changed(max_steering_angle=lock, command_delay=delay) for lock in locks for delay in DELAYS]
    paths = windows.predict(cars, np.repeat(windows.initial_states[None], len(cars), axis=0), ROUGH_SUBSTEPS)
    errors = [float(np.abs(windows.difference(path)[..., 2]).mean()) for path in paths]
    return cars[int(np.argmin(errors))]


def fit_located(
    drives: Sequence[LogSegment], start: DonkeyParameters | None = None, progress: Progress = SILENT
) -> tuple[TwinFit, Mounting]:
    """Fit parameters of the car to a located recording, see `fit`, and find where its poses are on the car."""
    start = start or DonkeyParameters()
    mounting = find_mounting(drives, start)
    drives = mounting.centred(drives)
    return fit(drives, rough_start(drives, start), LOCATED, progress), mounting
