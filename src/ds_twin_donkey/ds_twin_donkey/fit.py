"""Fits the car's parameters to recorded drives: least squares over short rollouts (multiple shooting).

Every drive is cut into windows. In each one the model starts from a state of its own, which is fitted along with the
parameters, so that neither noise of the first measurement nor slow drift of the model spoils what the window says.
Short windows come first, because a car 30 % off is soon elsewhere; then longer ones, which tell slow things apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ds_twin_donkey.dynamics import SUBSTEPS
from ds_twin_donkey.logs import CHANNELS, Drive
from ds_twin_donkey.parameters import DonkeyParameters
from ds_twin_donkey.residuals import FLOORS, FURTHEST, SCALES, Problem, Say
from ds_twin_donkey.windows import UNKNOWNS, FitError, Windows

Array = NDArray[np.float64]

FITTED = {
    "max_steering_angle": "rad", "steering_trim": "rad", "servo_rate": "rad/s", "servo_backlash": "rad",
    "command_delay": "s", "start_duty": "1", "full_duty": "1", "stall_force": "N", "drag_brake": "1",
    "motor_lag": "s", "rolling_resistance": "1", "friction": "1", "front_stiffness": "1/rad",
    "rear_stiffness": "1/rad",
}  # fmt: skip
"""Name -> unit of what is fitted. The rest is held: lengths and masses are measured with ruler and scales; doubling
`free_speed` and `stall_force` and halving both duties changes nothing, so one of them is read from the data sheet; and
the dead band is known to one pulse count only, which is 19 % of it."""
KNOWN, WIDEST = 0.05, 0.2
"""Half a 95 % interval over the value: up to the first a parameter is known, beyond the second not determined at all.
Chosen: 5 % is what the fit promises; at 20 % the nominal values are no worse."""
ROUNDS, SETTLED = 8, 0.1
"""Rounds of weighing and solving at most, and the relative change of the noise that ends them; chosen."""
ROUGH_SECONDS, ROUGH_LONGEST, ROUGH_SUBSTEPS = 3.0, 120.0, 10
"""Short windows (s), how much of the drives they cover (s), and steps per frame. Chosen: in 3 s a car 30 % off is not
yet anywhere else; two minutes bring it near; 10 steps are a third of a millimetre from 20, in half the time."""


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """How to fit.

    Attributes:
        window_seconds: length of a window; longer ones tell slow things apart, and need a model that follows so long.
        max_seconds: of all windows together, evenly spread over the drives; bounds time and memory.
        max_evaluations: of all residuals, in each of the rounds.
        names: of the parameters that are fitted, of those in `FITTED`.
    """

    window_seconds: float = 10.0
    max_seconds: float = 600.0
    max_evaluations: int = 40
    names: tuple[str, ...] = tuple(FITTED)


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

    @property
    def status(self) -> str:
        """`fitted` (half its interval is at most 5 %), `weakly fitted`, or `not determined`."""
        if not self.determined:
            return "not determined"
        half = 0.5 * (self.high - self.low)
        return "fitted" if half <= KNOWN * SCALES.get(self.name, abs(self.value)) else "weakly fitted"


@dataclass(frozen=True, kw_only=True)
class Fit:
    """What a fit found.

    Attributes:
        parameters: the car.
        estimates: one per name that was to be fitted.
        rms: per channel, of the residuals, in the channel's unit; NaN where nothing was measured.
        noise: per channel, white noise of the drives, in the channel's unit; NaN where nothing was measured.
        windows: how many were used.
        measured: (windows, frames, 5) of each window, columns as `logs.CHANNELS`.
        fitted: the same from the model.
    """

    parameters: DonkeyParameters
    estimates: tuple[Estimate, ...]
    rms: Mapping[str, float]
    noise: Mapping[str, float]
    windows: int
    measured: Array
    fitted: Array

    @property
    def misfit(self) -> dict[str, float]:
        """Per measured channel, residuals over the noise of the drives; about 1 where the model follows them."""
        least = dict(zip(CHANNELS, FLOORS, strict=True))
        return {name: rms / max(self.noise[name], least[name]) for name, rms in self.rms.items() if math.isfinite(rms)}


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
    names = list(settings.names)
    theta, eta, sigma = np.zeros(len(names)), np.zeros((0, UNKNOWNS)), None
    # What a start far off leaves over counts as noise at first: that keeps first states free to follow, and the steps
    # large. It shrinks from round to round to what the sensors leave.
    stages = [(settings.window_seconds, settings.max_seconds)]
    if settings.window_seconds > ROUGH_SECONDS:
        stages.insert(0, (ROUGH_SECONDS, min(ROUGH_LONGEST, settings.max_seconds)))
    for seconds, longest in stages:
        windows = Windows(drives, start, seconds, longest, FURTHEST * start.command_delay)
        problem = Problem(windows, start, ROUGH_SUBSTEPS)
        say(f"{problem.windows.count} windows of {seconds:g} s, {int(problem.windows.known.sum())} measured values")
        theta, eta = _rounds(problem, names, theta, sigma, settings, say)
        sigma = problem.sigma
    problem.substeps = SUBSTEPS
    theta, eta = problem.solve(names, theta, eta, settings.max_evaluations, say, 1e-5)
    held = _undetermined(problem, names, theta, eta)
    if held:
        say(f"not determined, left at their start: {', '.join(held)}")
        theta = theta[[name not in held for name in names]]
        names = [name for name in names if name not in held]
        if not names:
            raise FitError("the drives determine no parameter: record longer ones, with bends and changes of throttle")
        theta, eta = problem.solve(names, theta, eta, settings.max_evaluations, say, 1e-5)
    problem.weigh(names, theta, eta)
    width = problem.half_widths(names, theta, eta)
    found = dict(zip(names, zip(problem.values(names, theta), width, strict=True), strict=True))
    estimates = []
    for name in settings.names:
        unit = FITTED[name]
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
    squares = np.square(problem.windows.difference(predicted))
    known = problem.windows.known.sum(axis=(0, 1))
    rms = np.sqrt(squares.sum(axis=(0, 1)) / np.maximum(known, 1))
    measured = known > 0
    return Fit(
        parameters=problem.car(names, theta),
        estimates=tuple(estimates),
        rms=_by_channel(np.where(measured, rms, math.nan)),
        noise=_by_channel(np.where(measured, problem.windows.noise(), math.nan)),
        windows=problem.windows.count,
        measured=problem.windows.measured,
        fitted=predicted,
    )


def _by_channel(values: Array) -> dict[str, float]:
    return dict(zip(CHANNELS, values.tolist(), strict=True))


def _rounds(
    problem: Problem, names: Sequence[str], theta: Array, sigma: Array | None, settings: FitSettings, say: Say
) -> tuple[Array, Array]:
    """Weigh and solve until the noise has settled; `sigma` if it is already known about."""
    eta = problem.windows.first_states.copy()
    if sigma is None:
        problem.weigh(names, theta, eta)
    else:
        problem.sigma = sigma.copy()
    for _ in range(ROUNDS):
        before = problem.sigma.copy()
        theta, eta = problem.solve(names, theta, eta, settings.max_evaluations, say, 1e-3)
        problem.weigh(names, theta, eta)
        if np.all(np.abs(np.log(problem.sigma / before)) < SETTLED):
            break
    return theta, eta


def _undetermined(problem: Problem, names: Sequence[str], theta: Array, eta: Array) -> list[str]:
    """Drop the widest parameter until every interval is narrow enough; those dropped."""
    ours, states, _ = problem.jacobian(names, theta, eta)
    information, left, dropped = problem.information(ours, states), list(range(len(names))), []
    values = problem.values(names, theta)
    while left:
        widths = problem.widths([names[i] for i in left], information[np.ix_(left, left)])
        ranked = []
        for width, i in zip(widths, left, strict=True):
            low, high = problem.bounds(names[i])
            stuck = min(theta[i] - low, high - theta[i]) < 1e-3
            ranked.append(math.inf if stuck else width / SCALES.get(names[i], max(abs(values[i]), 1e-12)))
        worst = int(np.argmax(ranked))
        if ranked[worst] <= WIDEST:
            break
        dropped.append(names[left.pop(worst)])
    return dropped
