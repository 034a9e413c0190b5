"""Latent margins of tests on the siblings: a censored linear model with an effect that all simulators share.

The margin of test i on simulator s is the logarithm of the largest absolute lateral position over half a lane: 0 at
the lane's edge, where a test fails. A failed run ends there, so its margin is only known to be positive (a censored, or
Tobit, observation: Tobin, Econometrica 1958). The model is

    margin_is = x_i . theta_s + t_i + e_is,    t_i ~ N(0, omega^2),    e_is ~ N(0, sigma_s^2)

with features x_i (a 1 first), coefficients theta_s of each simulator, and a test effect t_i: what is hard about a test
on every simulator and not said by its features. The test effects are integrated out, in closed form over completed
runs and by Gauss-Hermite quadrature over the failed ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_ndtr

from ds_orchestrator.prediction.outcome_table import OutcomeTable, OutcomeTableError, State

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

SMALLEST_LATERAL = 0.05
"""m; smaller positions count as this: chosen, about the width of a line's edge, so that a logarithm near 0 means
nothing."""
FEWEST_TESTS = 10
"""Tests with a verdict on some sibling that a fit needs; chosen: two for each of the usual number of features would be
too few for a simulator alone, but the population's prior holds them."""
_SPREAD_CENTRE, _SPREAD_SCALE = np.log(0.3), 1.0
"""Weak prior of log omega and log sigma_s: within a factor of 7 of 0.3 (two standard deviations), which as a ratio of
lateral positions is 4 % to 800 %. It matters only where a spread is not identified, as with one sibling."""
_COEFFICIENT_SCALE = 2.0
"""Standard deviation of a normal prior that keeps the search for the mode finite where no test fails, or all do. It is
taken out of the likelihood again; see `Likelihood`."""
_MOST_WIDENING = 3.0
"""Largest factor on a residual variance for the coefficients fitted to it; chosen: reached where two of three completed
runs are used up by coefficients, where no correction saves the fit."""
_NODES, _NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(21)
_LOG_WEIGHTS = np.log(_NODE_WEIGHTS) - 0.5 * np.log(2.0 * np.pi)
_STEP = 1e-4
"""Step of the central differences of the gradient; errors of the second derivatives are of the order 1e-8."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Margins:
    """Margins of tests on siblings.

    Attributes:
        predictors: (tests, p) a 1, then the standardised features.
        centre: (p - 1,) means of the features.
        scale: (p - 1,) standard deviations of the features; 1 for one that does not vary.
        values: (tests, siblings) margins of completed runs; 0 elsewhere.
        observed: (tests, siblings) whether a run completed.
        censored: (tests, siblings) whether a run failed.
    """

    predictors: Array
    centre: Array
    scale: Array
    values: Array
    observed: Bools
    censored: Bools


@dataclass(frozen=True, kw_only=True, eq=False)
class Likelihood:
    """What the siblings' outcomes say about their coefficients: a normal approximation around its mode.

    Attributes:
        mode: (siblings, p) coefficients.
        information: (siblings p, siblings p) negative second derivatives of the log likelihood, spreads profiled out.
        linear: (siblings p,) such that the log likelihood is `linear @ theta - theta @ information @ theta / 2`.
        log_sigma: (siblings,) logarithms of the residual standard deviations.
        log_sigma_error: (siblings,) their standard errors.
        omega: standard deviation of the test effect.
        effect_mean: (tests,) posterior means of the test effects, given all siblings.
        effect_variance: (tests,) their posterior variances.
        converged: False if the search for the mode stopped early.
    """

    mode: Array
    information: Array
    linear: Array
    log_sigma: Array
    log_sigma_error: Array
    omega: float
    effect_mean: Array
    effect_variance: Array
    converged: bool


def margins_of(table: OutcomeTable) -> Margins:
    """Compute the margins of a table's tests on its siblings.

    Raises:
        OutcomeTableError: too few tests.
    """
    columns = [table.column(name) for name in table.siblings]
    states = table.states[:, columns]
    observed, censored = states == State.COMPLETED, states == State.FAILED
    driven = (observed | censored).any(axis=1)
    if driven.sum() < FEWEST_TESTS:
        raise OutcomeTableError(
            f"{int(driven.sum())} tests have a verdict on a sibling, expected at least {FEWEST_TESTS}: drive more tests"
        )
    for name, known in zip(table.siblings, (observed | censored).any(axis=0), strict=True):
        if not known:
            raise OutcomeTableError(f"no test has a verdict on {name}: drive tests there, or leave it out")
    centre, scale = table.features[driven].mean(axis=0), table.features[driven].std(axis=0)
    scale = np.where(scale > 1e-12, scale, 1.0)
    values = margin(table.lateral[:, columns], table.half_lanes[:, None])
    return Margins(
        predictors=np.column_stack((np.ones(len(table)), (table.features - centre) / scale)),
        centre=centre,
        scale=scale,
        values=np.where(observed, values, 0.0),
        observed=observed,
        censored=censored,
    )


def margin(lateral: Array, half_lane: Array) -> Array:
    """Margin of largest absolute lateral positions, m: 0 at the lane's edge, negative within the lane."""
    return np.asarray(np.log(np.maximum(lateral, SMALLEST_LATERAL) / half_lane))


def fit_margins(margins: Margins) -> Likelihood:
    """Find the mode of the likelihood and its curvature there; deterministic."""
    siblings, p = margins.values.shape[1], margins.predictors.shape[1]
    start = np.concatenate((np.zeros(siblings * p), np.full(siblings + 1, _SPREAD_CENTRE)))
    start[: siblings * p].reshape(siblings, p)[:, 0] = np.log(0.5)
    scale = max(len(margins.values), 1)

    def loss(parameters: Array) -> tuple[float, Array]:
        value, gradient = _log_posterior(margins, parameters)
        return -value / scale, -gradient / scale

    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 1000, "ftol": 1e-13, "gtol": 1e-8})
    mode = found.x
    second = _second_derivatives(margins, mode)
    k = siblings * p
    inverse = np.linalg.inv(second)
    # A mode leaves residuals too small by the coefficients that were fitted to them (as in a variance over n - p).
    counts = margins.observed.sum(axis=0)
    widening = np.where(counts > 0, counts / np.maximum(np.maximum(counts - p, counts / _MOST_WIDENING), 1e-9), 1.0)
    inverse[:k, :k] *= np.sqrt(np.outer(*(np.repeat(widening, p),) * 2))
    # Spreads are profiled out; the prior that kept the search finite is taken out of the coefficients.
    information = np.linalg.inv(inverse[:k, :k]) - np.eye(k) / _COEFFICIENT_SCALE**2
    values, vectors = np.linalg.eigh((information + information.T) / 2.0)
    information = (vectors * np.maximum(values, 0.0)) @ vectors.T
    theta = mode[:k]
    mean, variance = _test_effects(margins, mode)
    return Likelihood(
        mode=theta.reshape(siblings, p),
        information=information,
        linear=information @ theta + theta / _COEFFICIENT_SCALE**2,
        log_sigma=mode[k : k + siblings] + 0.5 * np.log(widening),
        log_sigma_error=np.sqrt(np.diag(inverse)[k : k + siblings]),
        omega=float(np.exp(mode[-1])),
        effect_mean=mean,
        effect_variance=variance,
        converged=bool(found.success),
    )


def _second_derivatives(margins: Margins, mode: Array) -> Array:
    """Negative second derivatives of the log posterior, by central differences of its gradient."""
    columns = []
    for k in range(len(mode)):
        step = np.zeros_like(mode)
        step[k] = _STEP
        above, below = (_log_posterior(margins, mode + sign * step)[1] for sign in (1.0, -1.0))
        columns.append((below - above) / (2.0 * _STEP))
    second = np.array(columns)
    return np.asarray((second + second.T) / 2.0)


@dataclass(frozen=True, eq=False)
class _Integrated:
    """Test effects integrated out at some parameters; arrays over tests (n), siblings (s) and nodes (q)."""

    residual: Array  # (n, s) values minus the linear part
    sigma: Array  # (s,)
    log_likelihood: Array  # (n,)
    node_weights: Array  # (n, q) posterior of the test effect
    effect: Array  # (n, q) test effect at the nodes
    mean: Array  # (n,)
    variance: Array  # (n,)
    hazard: Array  # (c, q) derivative of log Phi of censored runs
    standard: Array  # (c, q) its argument


def _integrate(margins: Margins, parameters: Array) -> _Integrated:
    siblings, p = margins.values.shape[1], margins.predictors.shape[1]
    k = siblings * p
    theta = parameters[:k].reshape(siblings, p)
    sigma, omega = np.exp(parameters[k : k + siblings]), float(np.exp(parameters[-1]))
    linear = margins.predictors @ theta.T
    residual = np.where(margins.observed, margins.values - linear, 0.0)
    precision = margins.observed / sigma**2
    variance = 1.0 / (1.0 / omega**2 + precision.sum(axis=1))
    mean = variance * (precision * residual).sum(axis=1)
    value = 0.5 * np.log(variance / omega**2) + 0.5 * mean**2 / variance
    value -= (margins.observed * (np.log(sigma) + 0.5 * np.log(2.0 * np.pi) + 0.5 * (residual / sigma) ** 2)).sum(
        axis=1
    )
    effect = mean[:, None] + np.sqrt(variance)[:, None] * _NODES
    log_terms = np.repeat(_LOG_WEIGHTS[None], len(residual), axis=0)
    tests, on = np.nonzero(margins.censored)
    standard = (linear[tests, on][:, None] + effect[tests]) / sigma[on][:, None]
    log_phi = log_ndtr(standard)
    np.add.at(log_terms, tests, log_phi)
    top = log_terms.max(axis=1)
    terms = np.exp(log_terms - top[:, None])
    total = terms.sum(axis=1)
    weights = terms / total[:, None]
    after = (weights * effect).sum(axis=1)
    left_censored = margins.censored.any(axis=1)
    spread = np.where(left_censored, (weights * (effect - after[:, None]) ** 2).sum(axis=1), variance)
    hazard = np.exp(-0.5 * standard**2 - 0.5 * np.log(2.0 * np.pi) - log_phi)
    return _Integrated(
        residual, sigma, value + top + np.log(total), weights, effect,
        np.where(left_censored, after, mean), spread, hazard, standard,
    )  # fmt: skip


def _log_posterior(margins: Margins, parameters: Array) -> tuple[float, Array]:
    """Log likelihood with the weak priors, and its gradient.

    The gradient is the posterior mean, over the test effects, of the gradient with known effects (Fisher's identity).
    """
    siblings, p = margins.values.shape[1], margins.predictors.shape[1]
    k = siblings * p
    at = _integrate(margins, parameters)
    omega = float(np.exp(parameters[-1]))
    left = at.residual - at.mean[:, None]
    by_linear = np.where(margins.observed, left / at.sigma**2, 0.0)
    by_sigma = np.where(margins.observed, (left**2 + at.variance[:, None]) / at.sigma**2 - 1.0, 0.0)
    tests, on = np.nonzero(margins.censored)
    weights = at.node_weights[tests]
    by_linear[tests, on] = (weights * at.hazard).sum(axis=1) / at.sigma[on]
    by_sigma[tests, on] = -(weights * at.hazard * at.standard).sum(axis=1)
    by_omega = ((at.mean**2 + at.variance) / omega**2 - 1.0).sum()
    theta, spreads = parameters[:k], parameters[k:]
    gradient = np.concatenate(((by_linear.T @ margins.predictors).ravel(), by_sigma.sum(axis=0), [by_omega]))
    gradient[:k] -= theta / _COEFFICIENT_SCALE**2
    gradient[k:] -= (spreads - _SPREAD_CENTRE) / _SPREAD_SCALE**2
    value = at.log_likelihood.sum() - 0.5 * (theta @ theta) / _COEFFICIENT_SCALE**2
    value -= 0.5 * float((((spreads - _SPREAD_CENTRE) / _SPREAD_SCALE) ** 2).sum())
    return float(value), gradient


def _test_effects(margins: Margins, parameters: Array) -> tuple[Array, Array]:
    at = _integrate(margins, parameters)
    return at.mean, at.variance
