"""The model's residuals in windows of recorded drives, and least squares over them (variable projection)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import t as student

from ds_twin_donkey.logs import CHANNELS
from ds_twin_donkey.parameters import DonkeyParameters
from ds_twin_donkey.windows import UNKNOWNS, FitError, Windows

Array = NDArray[np.float64]
Say = Callable[[str], None]

SCALES = {"steering_trim": 0.05}
"""What a parameter whose start may be 0 is measured against, rad; chosen: a trim that anyone would set right."""
FURTHEST = 2.5
"""A parameter stays within this factor of its start; chosen: well past any two cars of a kind."""
_STEP = 1e-4
"""Of the forward differences, relative; far above rounding and below any kink of play or rate limit."""
_PLAY = UNKNOWNS - 1
"""Which value of a first state is the place in the play; the only one with bounds, -1 and 1."""
_STEPPED = UNKNOWNS - 3
"""Values of a first state whose slopes are found by a step; those of its place and heading are known."""
_FOLLOWING = 3
"""Steps of the first states for other parameters; chosen: the second finds the best ones where the model is smooth."""
_FLUNG = 1e6
"""What a residual is at most."""
FLOORS = (5e-4, 5e-4, 5e-4, 1e-3, 2e-3)
"""Least noise per channel (m, m, rad, m/s, rad/s); chosen: below any sensor's, for noiseless logs."""


class Problem:
    """The residuals of the model in some windows, over the noise.

    Parameters are `theta`, scaled so that 0 is the start; first states of the windows are `eta`.

    Args:
        windows: of recorded drives.
        start: values of every parameter to begin with.
        substeps: of the model per frame.

    Attributes:
        substeps: as given; may be changed between calls.
        sigma: (5,) what a residual of each channel is measured against.
    """

    def __init__(self, windows: Windows, start: DonkeyParameters, substeps: int) -> None:
        self.windows, self._start, self.substeps = windows, start, substeps
        self.sigma = np.maximum(windows.noise(), FLOORS)

    def scale(self, name: str) -> float:
        """What a step of 1 of the scaled parameter is worth."""
        return SCALES.get(name, abs(float(getattr(self._start, name))) or 1.0)

    def values(self, names: Sequence[str], theta: Array) -> list[float]:
        """Parameters from scaled ones, 0 being the start."""
        return [float(getattr(self._start, n)) + self.scale(n) * float(x) for n, x in zip(names, theta, strict=True)]

    def car(self, names: Sequence[str], theta: Array) -> DonkeyParameters:
        """The start with some parameters changed."""
        return self._start.changed(**dict(zip(names, self.values(names, theta), strict=True)))

    def predict(self, cars: Sequence[DonkeyParameters], states: Array) -> Array:
        """See `Windows.predict`."""
        return self.windows.predict(cars, states, self.substeps)

    def residuals(self, names: Sequence[str], theta: Array, eta: Array) -> Array:
        """(windows, frames x 5 + 7) over the noise; the last seven columns hold the first state to its guess."""
        return self._deviations(self.predict([self.car(names, theta)], eta[None])[0], eta)

    def _deviations(self, predicted: Array, eta: Array) -> Array:
        scaled = self.windows.difference(predicted) / self.sigma
        off = (eta - self.windows.first_states) / self.windows.guess
        return np.concatenate((scaled.reshape(len(scaled), -1), off), axis=1)

    def jacobian(self, names: Sequence[str], theta: Array, eta: Array) -> tuple[Array, Array, Array]:
        """Slopes of `residuals` by parameters and by first states, and the residuals."""
        cars = [self.car(names, theta)]
        for column in range(len(names)):
            moved = theta.copy()
            moved[column] += _STEP
            cars.append(self.car(names, moved))
        states = np.repeat(eta[None], len(names) + 1 + _STEPPED, axis=0)
        steps = np.full((len(states), self.windows.count), _STEP)
        steps[-1] = np.where(eta[:, _PLAY] > 0.0, -_STEP, _STEP)  # past the ends of the play nothing changes
        for row in range(_STEPPED):
            states[len(names) + 1 + row, :, 3 + row] += steps[len(names) + 1 + row]
        rows = self.predict([*cars, *[cars[0]] * _STEPPED], states)
        slopes = (rows[1:] - rows[0]) / steps[1:, :, None, None]
        pose = np.zeros((3, *rows[0].shape))
        # Moving or turning a window's first pose moves or turns its whole path.
        pose[0, ..., 0] = pose[1, ..., 1] = pose[2, ..., 2] = 1.0
        pose[2, ..., 0] = -(rows[0][..., 1] - eta[:, None, 1])
        pose[2, ..., 1] = rows[0][..., 0] - eta[:, None, 0]
        both = np.concatenate((slopes[: len(names)], pose, slopes[len(names) :]))
        both = np.where(self.windows.known, both, 0.0) / self.sigma
        flat = both.reshape(len(both), self.windows.count, -1).transpose(1, 2, 0)
        guess = np.zeros((self.windows.count, UNKNOWNS, len(both)))
        guess[:, np.arange(UNKNOWNS), len(names) + np.arange(UNKNOWNS)] = 1.0 / self.windows.guess
        flat = np.concatenate((flat, guess), axis=1)
        return flat[..., : len(names)], flat[..., len(names) :], self._deviations(rows[0], eta)

    def solve(
        self, names: Sequence[str], theta: Array, eta: Array, evaluations: int, say: Say, tolerance: float
    ) -> tuple[Array, Array]:
        """Least squares from here over the parameters, each window's first state following them.

        This is variable projection: for any parameters the first states are those that leave least, found by one
        step along the tangent and one Gauss-Newton step, so SciPy sees a small dense problem.
        """
        anchor = _Anchor(self, names, theta, eta)
        if not anchor.projected.any():
            raise FitError("nothing in the drives depends on any parameter: record ones in which the car moves")
        states: dict[bytes, Array] = {}
        rounds = 0

        def residuals(values: Array) -> Array:
            with np.errstate(all="ignore"):
                states[values.tobytes()], rows = anchor.follow(values)
            return rows.ravel()

        def jacobian(values: Array) -> Array:
            nonlocal anchor, rounds
            anchor = _Anchor(self, names, values, states[values.tobytes()])
            states.clear()
            states[values.tobytes()] = anchor.eta
            cost = float(np.square(anchor.left).sum())
            say(f"iteration {rounds}: {cost / self.windows.known.sum():.5g} squared deviations per value")
            rounds += 1
            return anchor.projected

        low, high = zip(*(self.bounds(name) for name in names), strict=True)
        done = least_squares(
            residuals, theta, jacobian, bounds=(low, high), x_scale="jac", max_nfev=evaluations,
            ftol=tolerance, xtol=1e-5, gtol=None,
        )  # fmt: skip
        if not math.isfinite(done.cost):
            raise FitError("the model does not follow the drives at all: check units, signs and stamps of the logs")
        return done.x, states[done.x.tobytes()]

    def weigh(self, names: Sequence[str], theta: Array, eta: Array) -> None:
        """Take the noise of each channel from what the fit leaves over."""
        left = self.windows.difference(self.predict([self.car(names, theta)], eta[None])[0])
        spent = UNKNOWNS * self.windows.count + len(names)
        for channel in range(len(CHANNELS)):
            known = self.windows.known[..., channel]
            if known.any():
                share = 1.0 - spent / self.windows.known.sum()
                size = math.sqrt(float(np.mean(np.square(left[..., channel][known]))) / max(share, 0.1))
                self.sigma[channel] = max(size, FLOORS[channel])

    def half_widths(self, names: Sequence[str], theta: Array, eta: Array) -> list[float]:
        """Half a 95 % interval of each parameter, from the Jacobian with every window's first state left free."""
        ours, states, _ = self.jacobian(names, theta, eta)
        return self.widths(names, self.information(ours, states))

    def information(self, ours: Array, states: Array) -> Array:
        """What the windows say of the parameters once each has had its first state explained away."""
        total = np.zeros((ours.shape[2], ours.shape[2]))
        for mine, state in zip(ours, states, strict=True):
            explained = state @ np.linalg.lstsq(state, mine, rcond=1e-10)[0]
            total += mine.T @ (mine - explained)
        return 0.5 * (total + total.T)

    def widths(self, names: Sequence[str], information: Array) -> list[float]:
        """Half a 95 % interval of each parameter, in its unit."""
        size = np.sqrt(np.maximum(np.diag(information), 1e-18))
        powers, axes = np.linalg.eigh(information / np.outer(size, size))
        # A direction of which nothing is known gets a width past any limit.
        variance = np.square(axes) @ (1.0 / np.maximum(powers, 1e-12)) / size**2
        freedom = int(self.windows.known.sum()) - UNKNOWNS * self.windows.count - len(names)
        reach = float(student.ppf(0.975, max(freedom, 1)))
        return [reach * math.sqrt(v) * self.scale(name) for v, name in zip(variance, names, strict=True)]

    def bounds(self, name: str) -> tuple[float, float]:
        """Of the scaled parameter."""
        if name in SCALES:
            return -4.0, 4.0
        low, high = 1.0 / FURTHEST - 1.0, FURTHEST - 1.0
        if name == "max_steering_angle":
            high = min(high, 1.15 / self.scale(name) - 1.0)
        if name in ("full_duty", "start_duty", "drag_brake"):
            high = min(high, 0.98 / self.scale(name) - 1.0)
        return low, high


class _Anchor:
    """The problem made linear at a point, from where first states follow the parameters."""

    def __init__(self, problem: Problem, names: Sequence[str], theta: Array, eta: Array) -> None:
        self._problem, self._names, self.theta, self.eta = problem, names, theta.copy(), eta
        self._ours, self._states, self.left = problem.jacobian(names, theta, eta)
        self._inverse = np.linalg.pinv(self._states, rcond=1e-10)
        held = self._states.copy()
        held[..., _PLAY] = 0.0
        self._held = np.linalg.pinv(held, rcond=1e-10)
        # Wheels at an end of the play that would go further stay there while the parameters move.
        further = eta[:, _PLAY] - np.einsum("wj,wj->w", self._inverse[:, _PLAY], self.left)
        self._at_end = (np.abs(eta[:, _PLAY]) >= 1.0) & (further * eta[:, _PLAY] >= 1.0)
        inverse = np.where(self._at_end[:, None, None], self._held, self._inverse)
        self.projected: Array = (self._ours - self._states @ (inverse @ self._ours)).reshape(-1, len(names))

    def follow(self, theta: Array) -> tuple[Array, Array]:
        """First states and residuals for other parameters: the tangent, then Gauss-Newton, less far where worse."""
        eta, left = self.eta, self._left(theta, self.eta)
        goal = self._step(eta, self.left + self._ours @ (theta - self.theta))
        share = np.ones((len(eta), 1))
        for _ in range(_FOLLOWING):
            tried = eta + share * (goal - eta)
            again = self._left(theta, tried)
            better = (np.square(again).sum(axis=1) < np.square(left).sum(axis=1))[:, None]
            eta, left = np.where(better, tried, eta), np.where(better, again, left)
            goal, share = self._step(eta, left), np.where(better, 1.0, 0.25 * share)
        return eta, left

    def _left(self, theta: Array, eta: Array) -> Array:
        # A car that is flung out of numbers is a bad one, no more.
        left = np.nan_to_num(self._problem.residuals(self._names, theta, eta), nan=_FLUNG)
        return np.clip(left, -_FLUNG, _FLUNG)

    def _step(self, eta: Array, left: Array) -> Array:
        """Least squares over the first states of what is left at `eta`, no place beyond an end of the play."""
        free = eta - np.einsum("wij,wj->wi", self._inverse, left)
        place = np.where(self._at_end, eta[:, _PLAY], np.clip(free[:, _PLAY], -1.0, 1.0))
        moved = left + self._states[..., _PLAY] * (place - eta[:, _PLAY])[:, None]
        bound = eta - np.einsum("wij,wj->wi", self._held, moved)
        bound[:, _PLAY] = place
        return np.where((place == free[:, _PLAY])[:, None], free, bound)
