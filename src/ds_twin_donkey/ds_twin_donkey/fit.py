"""Fits the car's parameters to recorded drives: least squares over short rollouts (multiple shooting).

Every drive is cut into windows. In each one the model starts from a state of its own, which is fitted along with the
parameters, so that neither noise of the first measurement nor slow drift of the model spoils what the window says.
Servo, play and motor lag follow from the commands alone: they are run in over the seconds before the window.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import t as student

from ds_sim.simulator import FRAME_TIME
from ds_twin_donkey.batch import MOTION, Lanes
from ds_twin_donkey.logs import CHANNELS, Drive
from ds_twin_donkey.parameters import DonkeyParameters

Array = NDArray[np.float64]
Say = Callable[[str], None]

FITTED = {
    "max_steering_angle": "rad", "steering_trim": "rad", "servo_rate": "rad/s", "servo_backlash": "rad",
    "command_delay": "s", "start_duty": "1", "full_duty": "1", "stall_force": "N", "drag_brake": "1",
    "motor_lag": "s", "rolling_resistance": "1", "friction": "1", "front_stiffness": "1/rad",
    "rear_stiffness": "1/rad",
}  # fmt: skip
"""Name -> unit of what is fitted. The rest is held: lengths and masses are measured with ruler and scales; doubling
`free_speed` and `stall_force` and halving both duties changes nothing, so one of them is read from the data sheet; and
the dead band is known to one pulse count only, which is 19 % of it."""
_SCALES = {"steering_trim": 0.05}
"""What a parameter whose start may be 0 is measured against, rad; chosen: a trim that anyone would set right."""
WIDEST = 0.2
"""Half a 95 % interval over the value; a wider one is not determined. Chosen: the nominal values are no worse."""
FURTHEST = 2.5
"""A parameter stays within this factor of its start; chosen: well past any two cars of a kind."""
ROUNDS, SETTLED = 8, 0.1
"""Rounds of weighing and solving at most, and the relative change of the noise that ends them; chosen."""
RUN_IN = 5
"""Frames before a window's first residual; tyres and body (5 Hz, damped) have forgotten how they were set by then."""
_SETTLING = 30
"""Frames of commands before that; twelve time constants of the motor's lag, the slowest actuator."""
_NUISANCE = 6
"""Free values of a window's first state: x, y, yaw, speed, lateral speed, yaw rate."""
_FIRST_GUESS = np.array([np.inf, np.inf, np.inf, 0.1, 0.15, 0.3])
"""How far a first state may be off its smoothed measurement (m/s, m/s, rad/s); chosen: three to five times what the
smoothing leaves of usual noise, and for the lateral speed a slip of 0.1 at 1.5 m/s. It matters only where a window
forgets its first lateral speed before its first residual."""
_STANDS, _ROLLS = 0.03, 0.15
"""Model m/s. No window begins between them: whether friction holds the car there is a matter of noise. A slower car is
taken to stand. Chosen: smoothed noise of a speed sensor, and a few frames of getting under way."""
_REST = 1e-4
"""m/s, rad/s; what a standing car's first state may be off."""
_STEP = 1e-4
"""Of the forward differences, relative; far above rounding and below any kink of play or rate limit."""
_FLOORS = np.array([5e-4, 5e-4, 5e-4, 1e-3, 2e-3])
"""Least noise per channel (m, m, rad, m/s, rad/s); chosen: below any sensor's, for noiseless logs."""
_FASTEST_INITIAL_SLIP = 0.1
"""m/s; below this a window starts without slip, for slip is a ratio to the speed."""


class FitError(ValueError):
    """Drives to which nothing can be fitted."""


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """How to fit.

    Attributes:
        window_seconds: length of a window.
        max_windows: at most so many, evenly spread over the drives; bounds time and memory.
        max_evaluations: of all residuals, in each of the rounds.
    """

    window_seconds: float = 3.0
    max_windows: int = 120
    max_evaluations: int = 40


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A fitted parameter.

    Attributes:
        name: of the parameter.
        unit: "1" if it has none.
        value: fitted, or the start if not determined.
        low: lower end of the 95 % interval; NaN if not determined.
        high: its upper end.
        start: where the fit began.
        determined: whether the drives say what it is.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    start: float
    determined: bool


@dataclass(frozen=True, kw_only=True)
class Fit:
    """What a fit found.

    Attributes:
        parameters: the car.
        estimates: one per name of `FITTED`.
        rms: per channel, of the residuals, in the channel's unit; NaN where nothing was measured.
        windows: how many were used.
        measured: (windows, frames, 5) of each window, columns as `logs.CHANNELS`.
        fitted: the same from the model.
    """

    parameters: DonkeyParameters
    estimates: tuple[Estimate, ...]
    rms: Mapping[str, float]
    windows: int
    measured: Array
    fitted: Array


def fit(
    drives: Sequence[Drive],
    start: DonkeyParameters | None = None,
    settings: FitSettings | None = None,
    say: Say = lambda line: None,
) -> Fit:
    """Fit the parameters of `FITTED`; the same drives give the same result.

    Args:
        drives: recorded.
        start: where to begin, and the values of all that is not fitted; nominal if left out.
        settings: see `FitSettings`.
        say: gets a line per iteration.

    Raises:
        FitError: no drive is long enough, or the model does not follow the drives at all.
    """
    start, settings = start or DonkeyParameters(), settings or FitSettings()
    problem = _Problem(drives, start, settings)
    say(f"{problem.count} windows of {settings.window_seconds:g} s, {int(problem.known.sum())} measured values")
    names = list(FITTED)
    theta, eta = np.zeros(len(names)), problem.first_states.copy()
    # What a start far off leaves over counts as noise at first: that keeps first states free to follow, and the steps
    # large. It shrinks from round to round to what the sensors leave.
    for turn in range(ROUNDS):
        before = problem.sigma.copy()
        problem.weigh(names, theta, eta)
        if turn and np.all(np.abs(np.log(problem.sigma / before)) < SETTLED):
            break
        theta, eta = problem.solve(names, theta, eta, settings, say, 1e-3)
    theta, eta = problem.solve(names, theta, eta, settings, say)
    held = problem.undetermined(names, theta, eta)
    if held:
        say(f"not determined, left at their start: {', '.join(held)}")
        theta = theta[[name not in held for name in names]]
        names = [name for name in names if name not in held]
        if not names:
            raise FitError("the drives determine no parameter: record longer ones, with bends and changes of throttle")
        theta, eta = problem.solve(names, theta, eta, settings, say)
    problem.weigh(names, theta, eta)
    width = problem.half_widths(names, theta, eta)
    found = dict(zip(names, zip(problem.values(names, theta), width, strict=True), strict=True))
    estimates = []
    for name, unit in FITTED.items():
        before = float(getattr(start, name))
        value, half = found.get(name, (before, math.nan))
        estimates.append(
            Estimate(
                name=name,
                unit=unit,
                value=value,
                low=value - half,
                high=value + half,
                start=before,
                determined=name in found,
            )  # fmt: skip
        )
    predicted = problem.predict([problem.car(names, theta)], eta[None])[0]
    residuals = problem.difference(predicted)
    rms = {
        name: float(np.sqrt(np.mean(np.square(residuals[..., i][problem.known[..., i]]))))
        if problem.known[..., i].any()
        else math.nan
        for i, name in enumerate(CHANNELS)
    }
    return Fit(
        parameters=problem.car(names, theta), estimates=tuple(estimates), rms=rms, windows=problem.count,
        measured=problem.measured, fitted=predicted,
    )  # fmt: skip


class _Problem:
    """Windows of drives, and the model's residuals in them."""

    def __init__(self, drives: Sequence[Drive], start: DonkeyParameters, settings: FitSettings) -> None:
        self._start = start
        self._length = round(settings.window_seconds / FRAME_TIME)
        self._before = _SETTLING + _longest_delay(start)
        places = []
        for index, drive in enumerate(drives):
            first = RUN_IN if drive.from_rest else RUN_IN + self._before
            at = first
            while at + self._length <= len(drive.commands):
                begin = at - RUN_IN
                speed = abs(float(_state_at(drive.measured, begin, 0.0)[3]))
                if _STANDS <= speed < _ROLLS or not np.isfinite(drive.measured[at : at + self._length]).any():
                    at += 1
                    continue
                places.append((index, begin))
                at += self._length
        if not places:
            need = (RUN_IN + self._length) * FRAME_TIME
            raise FitError(f"no drive of {need:g} s without a gap: record longer ones, or take shorter windows")
        if len(places) > settings.max_windows:
            chosen = np.linspace(0, len(places) - 1, settings.max_windows).round().astype(int)
            places = [places[i] for i in chosen]
        self.count = len(places)
        frames = self._before + RUN_IN + self._length
        self._commands = np.zeros((frames, self.count, 2))
        self.measured = np.full((self.count, self._length, len(CHANNELS)), np.nan)
        self.first_states = np.zeros((self.count, _NUISANCE))
        self._guess = np.tile(_FIRST_GUESS, (self.count, 1))
        rear = start.wheelbase * start.front_share
        for window, (index, begin) in enumerate(places):
            drive = drives[index]
            padded = np.concatenate((np.zeros((self._before, 2)), drive.commands))
            self._commands[:, window] = padded[begin : begin + frames]
            self.measured[window] = drive.measured[begin + RUN_IN : begin + RUN_IN + self._length]
            self.first_states[window] = _state_at(drive.measured, begin, rear)
            if self.first_states[window, 3] < _STANDS:
                self.first_states[window, 3:] = 0.0
                self._guess[window, 3:] = _REST
        self.known = np.isfinite(self.measured)
        self.sigma = np.maximum(_noise(self.measured), _FLOORS)

    def scale(self, name: str) -> float:
        """What a step of 1 of the scaled parameter is worth."""
        return _SCALES.get(name, abs(float(getattr(self._start, name))) or 1.0)

    def values(self, names: Sequence[str], theta: Array) -> list[float]:
        """Parameters from scaled ones, 0 being the start."""
        return [float(getattr(self._start, n)) + self.scale(n) * float(x) for n, x in zip(names, theta, strict=True)]

    def car(self, names: Sequence[str], theta: Array) -> DonkeyParameters:
        """The start with some parameters changed."""
        return self._start.changed(**dict(zip(names, self.values(names, theta), strict=True)))

    def predict(self, cars: Sequence[DonkeyParameters], states: Array) -> Array:
        """Roll out every window from its first state: (cars, windows, 6) -> (cars, windows, frames, 5)."""
        sets = len(cars)
        lanes = Lanes(cars, np.repeat(np.arange(sets), self.count))
        pulses = lanes.pulses(np.tile(self._commands, (1, sets, 1)))
        actuators = lanes.settle(pulses, range(self._before - _SETTLING, self._before))
        motion = np.zeros((MOTION, sets * self.count))
        motion[:6] = states.reshape(-1, _NUISANCE).T
        _lean(motion, actuators[1], self._start)
        kept = np.empty((self._length, 6, sets * self.count))
        for frame in range(RUN_IN + self._length):
            if frame >= RUN_IN:
                kept[frame - RUN_IN] = motion[:6]
            if frame < RUN_IN + self._length - 1:
                motion, actuators = lanes.advance(motion, actuators, *lanes.delayed(pulses, self._before + frame))
        x, y, yaw, speed, _, rate = np.moveaxis(kept, 1, 0)
        ahead = self._start.wheelbase * (self._start.front_share - 0.5)
        rows = np.stack((x - ahead * np.cos(yaw), y - ahead * np.sin(yaw), yaw, speed, rate), axis=-1)
        return rows.reshape(self._length, sets, self.count, len(CHANNELS)).transpose(1, 2, 0, 3)

    def difference(self, predicted: Array) -> Array:
        """Model less measurement; 0 where nothing was measured."""
        return np.where(self.known, predicted - np.nan_to_num(self.measured), 0.0)

    def residuals(self, names: Sequence[str], theta: Array, eta: Array) -> Array:
        """(windows, frames x 5 + 6) over the noise; the last six columns hold the first state to its guess."""
        return self._deviations(self.predict([self.car(names, theta)], eta[None])[0], eta)

    def _deviations(self, predicted: Array, eta: Array) -> Array:
        scaled = self.difference(predicted) / self.sigma
        return np.concatenate((scaled.reshape(self.count, -1), (eta - self.first_states) / self._guess), axis=1)

    def jacobian(self, names: Sequence[str], theta: Array, eta: Array) -> tuple[Array, Array, Array]:
        """Slopes of `residuals` by parameters and by first states, and the residuals."""
        cars = [self.car(names, theta)]
        for column in range(len(names)):
            moved = theta.copy()
            moved[column] += _STEP
            cars.append(self.car(names, moved))
        states = np.repeat(eta[None], len(names) + 4, axis=0)
        for row in range(3):
            states[len(names) + 1 + row, :, 3 + row] += _STEP
        rows = self.predict([*cars, *[cars[0]] * 3], states)
        slopes = (rows[1:] - rows[0]) / _STEP
        pose = np.zeros((3, *rows[0].shape))
        # Moving or turning a window's first pose moves or turns its whole path.
        pose[0, ..., 0] = pose[1, ..., 1] = pose[2, ..., 2] = 1.0
        pose[2, ..., 0] = -(rows[0][..., 1] - eta[:, None, 1])
        pose[2, ..., 1] = rows[0][..., 0] - eta[:, None, 0]
        both = np.concatenate((slopes[: len(names)], pose, slopes[len(names) :]))
        both = np.where(self.known, both, 0.0) / self.sigma
        flat = both.reshape(len(both), self.count, -1).transpose(1, 2, 0)
        guess = np.zeros((self.count, _NUISANCE, len(both)))
        guess[:, np.arange(_NUISANCE), len(names) + np.arange(_NUISANCE)] = 1.0 / self._guess
        flat = np.concatenate((flat, guess), axis=1)
        return flat[..., : len(names)], flat[..., len(names) :], self._deviations(rows[0], eta)

    def solve(
        self, names: Sequence[str], theta: Array, eta: Array, settings: FitSettings, say: Say, tolerance: float = 1e-5
    ) -> tuple[Array, Array]:
        """Least squares from here over the parameters, each window's first state following them.

        This is variable projection: for any parameters the first states are those that leave least, found by one
        step along the tangent and one Gauss-Newton step, so SciPy sees a small dense problem.
        """
        anchor = _Anchor(self, names, theta, eta)
        states: dict[bytes, Array] = {}
        rounds = 0

        def residuals(values: Array) -> Array:
            with np.errstate(all="ignore"):
                states[values.tobytes()], rows = anchor.follow(values)
            # A step so far off that the car is flung out of numbers is a bad one, no more.
            return np.clip(np.nan_to_num(rows.ravel(), nan=1e6), -1e6, 1e6)

        def jacobian(values: Array) -> Array:
            nonlocal anchor, rounds
            anchor = _Anchor(self, names, values, states[values.tobytes()])
            states.clear()
            states[values.tobytes()] = anchor.eta
            cost = float(np.square(anchor.left).sum())
            say(f"iteration {rounds}: {cost / self.known.sum():.5g} squared deviations per value")
            rounds += 1
            return anchor.projected

        low, high = zip(*(self._bounds(name) for name in names), strict=True)
        done = least_squares(
            residuals, theta, jacobian, bounds=(low, high), x_scale="jac", max_nfev=settings.max_evaluations,
            ftol=tolerance, xtol=1e-5, gtol=None,
        )  # fmt: skip
        if not math.isfinite(done.cost):
            raise FitError("the model does not follow the drives at all: check units, signs and stamps of the logs")
        return done.x, states[done.x.tobytes()]

    def weigh(self, names: Sequence[str], theta: Array, eta: Array) -> None:
        """Take the noise of each channel from what the fit leaves over."""
        left = self.difference(self.predict([self.car(names, theta)], eta[None])[0])
        spent = _NUISANCE * self.count + len(names)
        for channel in range(len(CHANNELS)):
            known = self.known[..., channel]
            if known.any():
                share = 1.0 - spent / self.known.sum()
                size = math.sqrt(float(np.mean(np.square(left[..., channel][known]))) / max(share, 0.1))
                self.sigma[channel] = max(size, _FLOORS[channel])

    def half_widths(self, names: Sequence[str], theta: Array, eta: Array) -> list[float]:
        """Half a 95 % interval of each parameter, from the Jacobian with every window's first state left free."""
        ours, states, _ = self.jacobian(names, theta, eta)
        return self._widths(names, self._information(ours, states))

    def _information(self, ours: Array, states: Array) -> Array:
        total = np.zeros((ours.shape[2], ours.shape[2]))
        for mine, state in zip(ours, states, strict=True):
            explained = state @ np.linalg.lstsq(state, mine, rcond=1e-10)[0]
            total += mine.T @ (mine - explained)
        return 0.5 * (total + total.T)

    def _widths(self, names: Sequence[str], information: Array) -> list[float]:
        size = np.sqrt(np.maximum(np.diag(information), 1e-18))
        powers, axes = np.linalg.eigh(information / np.outer(size, size))
        # A direction of which nothing is known gets a width past any limit.
        variance = np.square(axes) @ (1.0 / np.maximum(powers, 1e-12)) / size**2
        freedom = int(self.known.sum()) - _NUISANCE * self.count - len(names)
        reach = float(student.ppf(0.975, max(freedom, 1)))
        return [reach * math.sqrt(v) * self.scale(name) for v, name in zip(variance, names, strict=True)]

    def undetermined(self, names: Sequence[str], theta: Array, eta: Array) -> list[str]:
        """Drop the widest parameter until every interval is narrow enough; those dropped."""
        ours, states, _ = self.jacobian(names, theta, eta)
        information, left, dropped = self._information(ours, states), list(range(len(names))), []
        values = self.values(names, theta)
        while left:
            widths = self._widths([names[i] for i in left], information[np.ix_(left, left)])
            relative = [
                w / _SCALES.get(names[i], max(abs(values[i]), 1e-12)) for w, i in zip(widths, left, strict=True)
            ]
            low_high = [self._bounds(names[i]) for i in left]
            stuck = [min(theta[i] - a, b - theta[i]) < 1e-3 for i, (a, b) in zip(left, low_high, strict=True)]
            ranked = [math.inf if s else r for r, s in zip(relative, stuck, strict=True)]
            worst = int(np.argmax(ranked))
            if ranked[worst] <= WIDEST:
                break
            dropped.append(names[left.pop(worst)])
        return dropped

    def _bounds(self, name: str) -> tuple[float, float]:
        if name in _SCALES:
            return -4.0, 4.0
        low, high = 1.0 / FURTHEST - 1.0, FURTHEST - 1.0
        if name == "max_steering_angle":
            high = min(high, 1.15 / self.scale(name) - 1.0)
        if name in ("full_duty", "start_duty", "drag_brake"):
            high = min(high, 0.98 / self.scale(name) - 1.0)
        return low, high


class _Anchor:
    """The problem made linear at a point, from where first states follow the parameters."""

    def __init__(self, problem: _Problem, names: Sequence[str], theta: Array, eta: Array) -> None:
        self._problem, self._names, self.theta, self.eta = problem, names, theta.copy(), eta
        ours, states, self.left = problem.jacobian(names, theta, eta)
        self._inverse = np.linalg.pinv(states, rcond=1e-10)
        self._ours = ours
        self.projected: Array = (ours - states @ (self._inverse @ ours)).reshape(-1, len(names))

    def follow(self, theta: Array) -> tuple[Array, Array]:
        """First states and residuals for other parameters."""
        tangent = self.left + self._ours @ (theta - self.theta)
        eta = self.eta - np.einsum("wij,wj->wi", self._inverse, tangent)
        left = self._problem.residuals(self._names, theta, eta)
        closer = eta - np.einsum("wij,wj->wi", self._inverse, np.nan_to_num(left))
        again = self._problem.residuals(self._names, theta, closer)
        if np.array_equal(theta, self.theta):
            kept = (np.square(self.left).sum(axis=1) < np.square(left).sum(axis=1))[:, None]
            eta, left = np.where(kept, self.eta, eta), np.where(kept, self.left, left)
        better = np.square(again).sum(axis=1) < np.square(left).sum(axis=1)
        return np.where(better[:, None], closer, eta), np.where(better[:, None], again, left)


def _longest_delay(start: DonkeyParameters) -> int:
    return math.ceil(FURTHEST * start.command_delay / FRAME_TIME) + 2


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


def _noise(measured: Array) -> Array:
    """White noise per channel from third differences, whose variance is 20 times that of the noise."""
    differences = np.abs(np.diff(measured, n=3, axis=1)).reshape(-1, measured.shape[2])
    sizes = np.zeros(measured.shape[2])
    for channel, column in enumerate(differences.T):
        known = column[np.isfinite(column)]
        if known.size:
            # Median of a normal's size is 0.6745 of its spread: robust against what the car itself does.
            sizes[channel] = np.median(known) / 0.6745 / math.sqrt(20.0)
    return sizes
