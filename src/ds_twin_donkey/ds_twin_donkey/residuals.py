# SPDX-License-Identifier: Apache-2.0
"""Residuals of the model in windows of recorded drives, and least squares over them (variable projection)."""

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

SCALES = {"steering_trim": 0.05}
"""Scale of a parameter whose start may be 0, rad; chosen: a trim that would always be noticed and corrected."""
MAX_FACTOR = 2.5
"""Factor of its start within which a parameter stays; chosen: more than two cars of a kind ever differ."""
_STEP = 1e-4
"""Relative step of the forward differences; far above rounding and below any kink due to play or rate limit."""
_PLAY = UNKNOWNS - 1
"""Index of the position within the play in an initial state; the only value with bounds, -1 and 1."""
_NUMERICAL = UNKNOWNS - 3
"""Number of values of an initial state differentiated numerically; the derivatives of the pose are known."""
_STATE_ITERATIONS = 3
"""Gauss-Newton steps of the initial states per set of parameters; chosen: two suffice where the model is smooth."""
_MAX_RESIDUAL = 1e6
"""Largest absolute value of a residual."""
FLOORS = (5e-4, 5e-4, 5e-4, 1e-3, 2e-3)
"""Smallest noise per channel (m, m, rad, m/s, rad/s); chosen: below that of any sensor, for noiseless logs."""


class Problem:
    """Least-squares problem: residuals of the model in some windows, relative to the noise.

    `theta` are the parameters, scaled so that 0 is the start; `eta` are the initial states of the windows; `sigma` is
    the noise of each channel, (5,), by which residuals are divided.
    """

    def __init__(self, windows: Windows, start: DonkeyParameters, substeps: int) -> None:
        self.windows, self._start, self.substeps = windows, start, substeps
        self.sigma = np.maximum(windows.noise(), FLOORS)

    def scale(self, name: str) -> float:
        """Change of a parameter per unit of the scaled parameter."""
        return SCALES.get(name, abs(float(getattr(self._start, name))) or 1.0)

    def values(self, names: Sequence[str], theta: Array) -> list[float]:
        """Convert scaled parameters to values; 0 is the start."""
        return [float(getattr(self._start, n)) + self.scale(n) * float(x) for n, x in zip(names, theta, strict=True)]

    def car(self, names: Sequence[str], theta: Array) -> DonkeyParameters:
        """Parameters of the car: the start with some of them replaced."""
        return self._start.changed(**dict(zip(names, self.values(names, theta), strict=True)))

    def predict(self, cars: Sequence[DonkeyParameters], states: Array) -> Array:
        """See `Windows.predict`."""
        return self.windows.predict(cars, states, self.substeps)

    def residuals(self, names: Sequence[str], theta: Array, eta: Array) -> Array:
        """Residuals over the noise, (windows, frames x 5 + 7); the last seven are priors on the initial state."""
        return self._deviations(self.predict([self.car(names, theta)], eta[None])[0], eta)

    def _deviations(self, predicted: Array, eta: Array) -> Array:
        scaled = self.windows.difference(predicted) / self.sigma
        off = (eta - self.windows.initial_states) / self.windows.initial_spread
        return np.concatenate((scaled.reshape(len(scaled), -1), off), axis=1)

    def jacobian(self, names: Sequence[str], theta: Array, eta: Array) -> tuple[Array, Array, Array]:
        """Derivatives of `residuals` with respect to parameters and initial states, and the residuals."""
        cars = [self.car(names, theta)]
        for column in range(len(names)):
            shifted = theta.copy()
            shifted[column] += _STEP
            cars.append(self.car(names, shifted))
        states = np.repeat(eta[None], len(names) + 1 + _NUMERICAL, axis=0)
        steps = np.full((len(states), self.windows.count), _STEP)
        steps[-1] = np.where(eta[:, _PLAY] > 0.0, -_STEP, _STEP)  # beyond the ends of the play nothing changes
        for row in range(_NUMERICAL):
            states[len(names) + 1 + row, :, 3 + row] += steps[len(names) + 1 + row]
        rows = self.predict([*cars, *[cars[0]] * _NUMERICAL], states)
        slopes = (rows[1:] - rows[0]) / steps[1:, :, None, None]
        pose = np.zeros((3, *rows[0].shape))
        # Moving or rotating the first pose of a window moves or rotates its whole path.
        pose[0, ..., 0] = pose[1, ..., 1] = pose[2, ..., 2] = 1.0
        pose[2, ..., 0] = -(rows[0][..., 1] - eta[:, None, 1])
        pose[2, ..., 1] = rows[0][..., 0] - eta[:, None, 0]
        both = np.concatenate((slopes[: len(names)], pose, slopes[len(names) :]))
        both = np.where(self.windows.known, both, 0.0) / self.sigma
        flat = both.reshape(len(both), self.windows.count, -1).transpose(1, 2, 0)
        prior = np.zeros((self.windows.count, UNKNOWNS, len(both)))
        prior[:, np.arange(UNKNOWNS), len(names) + np.arange(UNKNOWNS)] = 1.0 / self.windows.initial_spread
        flat = np.concatenate((flat, prior), axis=1)
        return flat[..., : len(names)], flat[..., len(names) :], self._deviations(rows[0], eta)

    def solve(
        self,
        names: Sequence[str],
        theta: Array,
        eta: Array,
        evaluations: int,
        tolerance: float,
        iterated: Callable[[str], None],
    ) -> tuple[Array, Array]:
        """Minimise the squares over the parameters, with the initial state of each window eliminated.

        This is variable projection: for any parameters the initial states are those with the smallest residuals, found
        by one step along the tangent and one Gauss-Newton step, so that SciPy solves a small dense problem. It ends at
        a relative change of the cost, or after so many evaluations of all residuals; `iterated` gets a line for each.
        FitError if no parameter has any effect, or if the model does not follow the drives.
        """
        anchor = _Anchor(self, names, theta, eta)
        if not anchor.projected.any():
            raise FitError("no parameter has any effect on the drives: record drives in which the car moves")
        states: dict[bytes, Array] = {}
        iterations = 0

        def residuals(values: Array) -> Array:
            with np.errstate(all="ignore"):
                states[values.tobytes()], rows = anchor.follow(values)
            return rows.ravel()

        def jacobian(values: Array) -> Array:
            nonlocal anchor, iterations
            anchor = _Anchor(self, names, values, states[values.tobytes()])
            states.clear()
            states[values.tobytes()] = anchor.eta
            cost = float(np.square(anchor.residual).sum())
            iterated(f"iteration {iterations}: {cost / self.windows.known.sum():.5g} squared deviations per value")
            iterations += 1
            return anchor.projected

        low, high = zip(*(self.bounds(name) for name in names), strict=True)
        done = least_squares(
            residuals,
            theta,
            jacobian,
            bounds=(low, high),
            x_scale="jac",
            max_nfev=evaluations,
            ftol=tolerance,
            xtol=1e-5,
            gtol=None,
        )
        if not math.isfinite(done.cost):
            raise FitError("the model does not follow the drives at all: check units, signs and stamps of the logs")
        return done.x, states[done.x.tobytes()]

    def weigh(self, names: Sequence[str], theta: Array, eta: Array) -> None:
        """Estimate the noise of each channel from the residuals of the fit."""
        residual = self.windows.difference(self.predict([self.car(names, theta)], eta[None])[0])
        spent = UNKNOWNS * self.windows.count + len(names)
        for channel in range(len(CHANNELS)):
            recorded = self.windows.known[..., channel]
            if recorded.any():
                share = 1.0 - spent / self.windows.known.sum()
                size = math.sqrt(float(np.mean(np.square(residual[..., channel][recorded]))) / max(share, 0.1))
                self.sigma[channel] = max(size, FLOORS[channel])

    def information(self, by_parameters: Array, by_states: Array) -> Array:
        """Information matrix of the parameters with the initial states of all windows eliminated."""
        total = np.zeros((by_parameters.shape[2], by_parameters.shape[2]))
        for parameters, state in zip(by_parameters, by_states, strict=True):
            explained = state @ np.linalg.lstsq(state, parameters, rcond=1e-10)[0]
            total += parameters.T @ (parameters - explained)
        return 0.5 * (total + total.T)

    def widths(self, names: Sequence[str], information: Array) -> list[float]:
        """Half-widths of the 95% intervals from an information matrix, each in the unit of its parameter."""
        size = np.sqrt(np.maximum(np.diag(information), 1e-18))
        powers, axes = np.linalg.eigh(information / np.outer(size, size))
        # A direction without information gets a width beyond any limit.
        variance = np.square(axes) @ (1.0 / np.maximum(powers, 1e-12)) / size**2
        freedom = int(self.windows.known.sum()) - UNKNOWNS * self.windows.count - len(names)
        reach = float(student.ppf(0.975, max(freedom, 1)))
        return [reach * math.sqrt(v) * self.scale(name) for v, name in zip(variance, names, strict=True)]

    def bounds(self, name: str) -> tuple[float, float]:
        """Bounds of a scaled parameter."""
        if name in SCALES:
            return -4.0, 4.0
        low, high = 1.0 / MAX_FACTOR - 1.0, MAX_FACTOR - 1.0
        if name == "max_steering_angle":
            high = min(high, 1.15 / self.scale(name) - 1.0)
        if name in ("full_duty", "start_duty", "drag_brake"):
            high = min(high, 0.98 / self.scale(name) - 1.0)
        return low, high


class _Anchor:
    """Linearisation of the problem at a point, from which initial states are computed for other parameters."""

    def __init__(self, problem: Problem, names: Sequence[str], theta: Array, eta: Array) -> None:
        self._problem, self._names, self.theta, self.eta = problem, names, theta.copy(), eta
        self._by_parameters, self._by_states, self.residual = problem.jacobian(names, theta, eta)
        self._inverse = np.linalg.pinv(self._by_states, rcond=1e-10)
        held = self._by_states.copy()
        held[..., _PLAY] = 0.0
        self._held = np.linalg.pinv(held, rcond=1e-10)
        # Wheels that are pushed against an end of the play stay there while the parameters change.
        unbounded = eta[:, _PLAY] - np.einsum("wj,wj->w", self._inverse[:, _PLAY], self.residual)
        self._at_end = (np.abs(eta[:, _PLAY]) >= 1.0) & (unbounded * eta[:, _PLAY] >= 1.0)
        inverse = np.where(self._at_end[:, None, None], self._held, self._inverse)
        self.projected: Array = (self._by_parameters - self._by_states @ (inverse @ self._by_parameters)).reshape(
            -1, len(names)
        )

    def follow(self, theta: Array) -> tuple[Array, Array]:
        """Initial states and residuals for other parameters: along the tangent, then Gauss-Newton with damping."""
        eta, residual = self.eta, self._residual(theta, self.eta)
        goal = self._step(eta, self.residual + self._by_parameters @ (theta - self.theta))
        share = np.ones((len(eta), 1))
        for _ in range(_STATE_ITERATIONS):
            tried = eta + share * (goal - eta)
            again = self._residual(theta, tried)
            better = (np.square(again).sum(axis=1) < np.square(residual).sum(axis=1))[:, None]
            eta, residual = np.where(better, tried, eta), np.where(better, again, residual)
            goal, share = self._step(eta, residual), np.where(better, 1.0, 0.25 * share)
        return eta, residual

    def _residual(self, theta: Array, eta: Array) -> Array:
        # A car that diverges to NaN is only a bad candidate, not an error.
        residual = np.nan_to_num(self._problem.residuals(self._names, theta, eta), nan=_MAX_RESIDUAL)
        return np.clip(residual, -_MAX_RESIDUAL, _MAX_RESIDUAL)

    def _step(self, eta: Array, residual: Array) -> Array:
        """Initial states that minimise the linearised residuals at `eta`, with the position within the play bounded."""
        free = eta - np.einsum("wij,wj->wi", self._inverse, residual)
        place = np.where(self._at_end, eta[:, _PLAY], np.clip(free[:, _PLAY], -1.0, 1.0))
        remaining = residual + self._by_states[..., _PLAY] * (place - eta[:, _PLAY])[:, None]
        bound = eta - np.einsum("wij,wj->wi", self._held, remaining)
        bound[:, _PLAY] = place
        return np.where((place == free[:, _PLAY])[:, None], free, bound)
