# SPDX-License-Identifier: Apache-2.0
"""Fits the car's parameters to recorded drives: least squares over short simulations (multiple shooting).

Every drive is cut into windows. The model starts each window from its own initial state, which is fitted along with the
parameters, so that neither noise of the first measurement nor slow drift of the model affects the result. Short windows
come first, because a car with parameters 30% off diverges quickly; longer ones then separate slow effects.

Poses that `ds recording locate` has located are smoothed over some images, so servo, play and tyres cannot be separated
from a delay, nor parts of the motor from each other: `LOCATED` holds them. And they are those of the point below the
camera, as the camera looks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ds_base.progress import SILENT, Progress
from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.dynamics import SUBSTEPS
from ds_twin_donkey.logs import CHANNELS, LogSegment
from ds_twin_donkey.parameters import GRAVITY, DonkeyParameters
from ds_twin_donkey.residuals import FLOORS, MAX_FACTOR, SCALES, Problem
from ds_twin_donkey.windows import UNKNOWNS, FitError, Windows

Array = NDArray[np.float64]

FITTED = {
    "max_steering_angle": "rad", "steering_trim": "rad", "servo_rate": "rad/s", "servo_backlash": "rad",
    "command_delay": "s", "start_duty": "1", "full_duty": "1", "stall_force": "N", "drag_brake": "1",
    "motor_lag": "s", "rolling_resistance": "1", "friction": "1", "front_stiffness": "1/rad",
    "rear_stiffness": "1/rad",
}  # fmt: skip
"""Fitted parameters, name -> unit. All others are held: lengths and masses are measured with ruler and scales; doubling
`free_speed` and `stall_force` and halving both duties changes nothing, so one of them is taken from the data sheet; and
the dead band can be known to one pulse count only, which is 19% of it."""
KNOWN, WIDEST = 0.05, 0.2
"""Half-width of the 95% interval over the value: up to the first a parameter is fitted, beyond the second it is not
determined. Chosen: 5% is the accuracy that the fit promises; at 20% the nominal values are no worse."""
MAX_ROUNDS, SETTLED = 8, 0.1
"""Largest number of rounds of weighting and solving, and the relative change of the noise that ends them; chosen."""
ROUGH_SECONDS, ROUGH_TOTAL, ROUGH_SUBSTEPS = 3.0, 120.0, 10
"""Length of the short windows (s), their total (s), and substeps per step. Chosen: in 3 s a car 30% off does not
diverge yet; two minutes bring it close; 10 substeps differ from 20 by a third of a millimetre, in half the time."""

TYPICAL, COST = (4, 4, 8), (1.0, 2.0, 4.0)
"""Iterations of the three phases that usually suffice, and their relative duration; measured on drives of the twin."""


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Settings of a fit."""

    # Length of a window, s; longer ones separate slow effects, but the model must be accurate for as long.
    window_seconds: float = 10.0
    max_seconds: float = 600.0  # total length of all windows, evenly spread over the drives, s; bounds time and memory
    max_evaluations: int = 40  # largest number of evaluations of all residuals per round
    names: tuple[str, ...] = tuple(FITTED)  # parameters to fit, a subset of `FITTED`


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimate of a fitted parameter."""

    name: str  # name of the parameter
    unit: str  # unit; "1" if dimensionless
    value: float  # fitted value, or the start if not determined
    low: float  # lower end of the 95% interval; NaN if not determined
    high: float  # upper end of the 95% interval; NaN if not determined
    start: float  # value from which the fit started

    @property
    def determined(self) -> bool:
        """Whether the drives determine the value."""
        return math.isfinite(self.low)

    @property
    def status(self) -> str:
        """`fitted` (half-width of the interval at most 5%), `weakly fitted`, or `not determined`."""
        if not self.determined:
            return "not determined"
        half = 0.5 * (self.high - self.low)
        return "fitted" if half <= KNOWN * SCALES.get(self.name, abs(self.value)) else "weakly fitted"


@dataclass(frozen=True, kw_only=True)
class TwinFit:
    """Result of a fit."""

    parameters: DonkeyParameters  # parameters of the car, fitted and held ones
    estimates: tuple[Estimate, ...]  # one per parameter to fit
    # Root mean square of the residuals per channel, in its unit; NaN where nothing was measured.
    rms: Mapping[str, float]
    noise: Mapping[str, float]  # white noise of the drives per channel, in its unit; NaN where nothing was measured
    windows: int  # number of windows used
    measured: Array  # (windows, frames, 5) measurements, columns as `logs.CHANNELS`
    fitted: Array  # (windows, frames, 5) simulated values

    @property
    def misfit(self) -> dict[str, float]:
        """Residuals over the noise of the drives, per measured channel; about 1 where the model follows them."""
        floors = dict(zip(CHANNELS, FLOORS, strict=True))
        return {name: rms / max(self.noise[name], floors[name]) for name, rms in self.rms.items() if math.isfinite(rms)}


def fit(
    drives: Sequence[LogSegment],
    start: DonkeyParameters | None = None,
    settings: FitSettings | None = None,
    progress: Progress = SILENT,
) -> TwinFit:
    """Fit parameters to recorded drives, from a start that others keep, or the nominal one; deterministic.

    The progress counts the work of all phases, and has a line for each iteration. FitError if no drive is long enough,
    or if the model does not follow the drives at all.
    """
    start, settings = start or DonkeyParameters(), settings or FitSettings()
    names = list(settings.names)
    theta, eta, sigma = np.zeros(len(names)), np.zeros((0, UNKNOWNS)), None
    # Residuals of a start that is far off count as noise at first: that keeps initial states free and steps large. The
    # noise shrinks from round to round to that of the sensors.
    stages = [(settings.window_seconds, settings.max_seconds)]
    if settings.window_seconds > ROUGH_SECONDS:
        stages.insert(0, (ROUGH_SECONDS, min(ROUGH_TOTAL, settings.max_seconds)))
    phases = _Phases(progress, first=3 - len(stages))
    for phase, (seconds, max_total) in enumerate(stages, start=3 - len(stages)):
        windows = Windows(drives, start, seconds, max_total, MAX_FACTOR * start.command_delay)
        problem = Problem(windows, start, ROUGH_SUBSTEPS)
        counts = f"{problem.windows.count} windows of {seconds:g} s, {int(problem.windows.known.sum())} measured values"
        phases.begin(phase, counts)
        theta, eta = _rounds(problem, names, theta, sigma, settings.max_evaluations, phases.iterated)
        sigma = problem.sigma
    problem.substeps = SUBSTEPS
    phases.begin(3, "the model at its full rate")
    theta, eta = problem.solve(names, theta, eta, settings.max_evaluations, 1e-5, phases.iterated)
    held = _undetermined(problem, names, theta, eta)
    if held:
        progress.describe(f"not determined, left at their start: {', '.join(held)}")
        theta = theta[[name not in held for name in names]]
        names = [name for name in names if name not in held]
        if not names:
            raise FitError("the drives determine no parameter: record longer ones, with bends and changes of throttle")
        theta, eta = problem.solve(names, theta, eta, settings.max_evaluations, 1e-5, phases.iterated)
    problem.weigh(names, theta, eta)
    widths = problem.widths(names, problem.information(*problem.jacobian(names, theta, eta)[:2]))
    values = dict(zip(names, zip(problem.values(names, theta), widths, strict=True), strict=True))
    estimates = []
    for name in settings.names:
        before = float(getattr(start, name))
        value, half = values.get(name, (before, math.nan))
        estimates.append(
            Estimate(name=name, unit=FITTED[name], value=value, low=value - half, high=value + half, start=before)
        )
    predicted = problem.predict([problem.car(names, theta)], eta[None])[0]
    squares = np.square(problem.windows.difference(predicted))
    samples = problem.windows.known.sum(axis=(0, 1))
    rms = np.sqrt(squares.sum(axis=(0, 1)) / np.maximum(samples, 1))
    measured = samples > 0
    return TwinFit(
        parameters=problem.car(names, theta),
        estimates=tuple(estimates),
        rms=_by_channel(np.where(measured, rms, math.nan)),
        noise=_by_channel(np.where(measured, problem.windows.noise(), math.nan)),
        windows=problem.windows.count,
        measured=problem.windows.measured,
        fitted=predicted,
    )


class _Phases:
    """Counts iterations by what they cost in their phase."""

    def __init__(self, progress: Progress, *, first: int) -> None:
        self._progress, self._left, self._cost = progress, 0.0, 0.0
        progress.start(float(np.dot(TYPICAL[first - 1 :], COST[first - 1 :])))

    def begin(self, phase: int, line: str) -> None:
        self._progress.advance(self._left * self._cost)  # what the phase before did not need
        self._left, self._cost = TYPICAL[phase - 1], COST[phase - 1]
        self._progress.describe(f"phase {phase} of 3: {line}")

    def iterated(self, line: str) -> None:
        # More iterations than usual share what is left of the phase, so that the time left never stands still.
        done = min(1.0, self._left / 2.0)
        self._left -= done
        self._progress.advance(self._cost * done, line)


def _by_channel(values: Array) -> dict[str, float]:
    return dict(zip(CHANNELS, values.tolist(), strict=True))


def _rounds(
    problem: Problem,
    names: Sequence[str],
    theta: Array,
    sigma: Array | None,
    evaluations: int,
    iterated: Callable[[str], None],
) -> tuple[Array, Array]:
    """Alternate weighting and solving until the noise has settled; `sigma` is the noise to start with, if known."""
    eta = problem.windows.initial_states.copy()
    if sigma is None:
        problem.weigh(names, theta, eta)
    else:
        problem.sigma = sigma.copy()
    for _ in range(MAX_ROUNDS):
        before = problem.sigma.copy()
        theta, eta = problem.solve(names, theta, eta, evaluations, 1e-3, iterated)
        problem.weigh(names, theta, eta)
        if np.all(np.abs(np.log(problem.sigma / before)) < SETTLED):
            break
    return theta, eta


def _undetermined(problem: Problem, names: Sequence[str], theta: Array, eta: Array) -> list[str]:
    """Drop the parameter with the widest interval until all are narrow enough; returns those dropped."""
    by_parameters, by_states, _ = problem.jacobian(names, theta, eta)
    information, kept, dropped = problem.information(by_parameters, by_states), list(range(len(names))), []
    values = problem.values(names, theta)
    while kept:
        widths = problem.widths([names[i] for i in kept], information[np.ix_(kept, kept)])
        ranked = []
        for width, i in zip(widths, kept, strict=True):
            low, high = problem.bounds(names[i])
            stuck = min(theta[i] - low, high - theta[i]) < 1e-3
            ranked.append(math.inf if stuck else width / SCALES.get(names[i], max(abs(values[i]), 1e-12)))
        worst = int(np.argmax(ranked))
        if ranked[worst] <= WIDEST:
            break
        dropped.append(names[kept.pop(worst)])
    return dropped


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
    turn: rows that do not fit are left out. The mounting is that of the centre itself if hardly any rows are left.
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
