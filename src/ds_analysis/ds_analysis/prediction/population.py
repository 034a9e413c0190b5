"""Simulators as draws from a population: what three siblings say about a simulator, or a car, that was never driven.

Coefficients of simulator s (see `ds_analysis.prediction.margins`) are draws theta_s ~ N(beta, T), with T diagonal:
tau_a^2 for the intercept, tau_b^2 for every slope. The twin is one more draw, so its boundary may lie outside of what
the siblings span. With few siblings the between-simulator standard deviations are hardly identified: they get weakly
informative half-normal priors, and are integrated out over a grid. At each of its points the coefficients are
approximated by a normal distribution around their mode (the nested Laplace approximation, INLA: Rue, Martino, Chopin,
J. R. Stat. Soc. B 2009). The result is a mixture of normals, without random numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import norm

from ds_analysis.common.statistics import Array
from ds_analysis.prediction.margins import Curvature, Margins, curvature_of

INTERCEPT_SCALE = 1.0
"""Scale of the half-normal prior of tau_a: the wider of the two (0.5 and 1) that Roever et al. (Res. Synth. Methods
2021) recommend for logarithms of ratios. Fits of four simulators with two networks have tau_a near 1.6, which 0.5 all
but rules out (docs/merge.md)."""
SLOPE_SCALE = 0.25
"""Scale of the half-normal prior of tau_b, for standardised features; chosen: half of the narrower scale of Roever et
al., so that two standard deviations from a feature's mean a slope matters as much. Those fits have 0.25 to 0.36."""
SPREAD_SCALE = 0.25
"""Standard deviation of the twin's log sigma around that of the siblings: a factor of 1.6 either way (two standard
deviations); chosen, as `SLOPE_SCALE`."""
_MEAN_CENTRE, _MEAN_SCALE = float(np.log(0.25)), 2.0
"""Prior of the population's mean margin of a typical test: from tests that nobody fails to tests that all fail."""
_MEAN_SLOPE_SCALE = 1.0
"""Standard deviation of the prior of the population's mean slopes: lateral positions that a feature multiplies by up to
7 (two standard deviations) from one standard deviation to the next."""
_NOISE_CENTRE, _NOISE_SCALE = float(np.log(0.3)), 0.5
"""Prior of log sigma and log omega: ratios of lateral positions of repeated or similar tests between 1.1 and 2.3 (two
standard deviations either way of 0.3). It decides where few margins are known."""
KINDS = ("alike", "other level", "unlike")
"""Kinds of simulators, by what the siblings say of one more: *alike* ones are draws from the population and share what
is hard about a test; of those of an *other level* only the features' slopes are known, and not how often they fail; of
*unlike* ones nothing, so that their drives alone show their failure rate."""
_GRID = (9, 5)
"""Values of tau_a and tau_b: Gauss-Legendre nodes of their prior probabilities."""
_SPREAD_NODES = 3
"""Gauss-Hermite nodes of the twin's log sigma."""
_STEPS, _CLOSE = 50, 1e-8
"""Newton's steps at most, and the decrement at which they end."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CoefficientMixture:
    """Distribution of a simulator's coefficients: a mixture of normals.

    Attributes:
        log_weights: (k,) logarithms of the weights, which sum to 1.
        means: (k, p) means of the coefficients.
        covariances: (k, p, p) their covariances.
        sigmas: (k,) residual standard deviations.
        kinds: (k,) which of `KINDS` of simulators each belongs to; only those that are alike share what is hard about a
            test beyond its features.
    """

    log_weights: Array
    means: Array
    covariances: Array
    sigmas: Array
    kinds: Array

    @property
    def weights(self) -> Array:
        """(k,) weights."""
        return np.asarray(np.exp(self.log_weights))

    @property
    def alike(self) -> CoefficientMixture:
        """What remains if the simulator is of the first kind."""
        kept = self.kinds == 0
        weights = self.log_weights[kept] - logsumexp(self.log_weights[kept])
        return CoefficientMixture(
            log_weights=weights, means=self.means[kept], covariances=self.covariances[kept],
            sigmas=self.sigmas[kept], kinds=self.kinds[kept],
        )  # fmt: skip

    @property
    def shares(self) -> Array:
        """(kinds,) weights of the kinds of simulators."""
        return np.asarray(np.bincount(self.kinds, self.weights, len(KINDS)), np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Population:
    """Posterior of the population, of its siblings, and of one more simulator.

    Attributes:
        twin: coefficients of a simulator that was never driven.
        limit: the same if the siblings' coefficients were known: what any number of tests on them leaves uncertain.
        siblings: (k, siblings p) means of the siblings' coefficients, at the grid's points.
        sibling_covariances: (k, siblings p, siblings p) their covariances.
        grid_weights: (k,) weights of the grid's points.
        mean: (p,) posterior mean of the population's mean coefficients.
        mean_error: (p,) posterior standard deviations of those.
        tau_intercept: posterior mean of tau_a.
        tau_slope: posterior mean of tau_b.
        sigma: residual standard deviation of the siblings' margins.
        omega: standard deviation of the test effects.
        effect_mean: (tests,) posterior means of the test effects, given all siblings.
        effect_variance: (tests,) their posterior variances.
    """

    twin: CoefficientMixture
    limit: CoefficientMixture
    siblings: Array
    sibling_covariances: Array
    grid_weights: Array
    mean: Array
    mean_error: Array
    tau_intercept: float
    tau_slope: float
    sigma: float
    omega: float
    effect_mean: Array
    effect_variance: Array

    @property
    def sibling_means(self) -> Array:
        """(siblings, p) posterior means of the siblings' coefficients."""
        return np.asarray((self.grid_weights @ self.siblings).reshape(-1, len(self.mean)))

    def document(self) -> dict[str, Any]:
        """Convert to JSON values; coefficients belong to a 1 and the standardised features."""
        return {
            "mean": self.mean.tolist(),
            "mean_error": self.mean_error.tolist(),
            "siblings": self.sibling_means.tolist(),
            "tau_intercept": self.tau_intercept,
            "tau_slope": self.tau_slope,
            "sigma": self.sigma,
            "omega": self.omega,
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class _Point:
    """Normal approximation at one point of the grid: siblings' coefficients, then the population's mean."""

    log_evidence: float
    mode: Array
    covariance: Array


def fit_population(margins: Margins) -> Population:
    """Fit the population to the siblings' margins; deterministic.

    Sigma and omega are the mode of their posterior at the medians of the between-simulator standard deviations.
    """
    siblings, p = margins.values.shape[1], margins.predictors.shape[1]
    start = np.tile(np.concatenate(([_MEAN_CENTRE], np.zeros(p - 1))), siblings + 1)
    median_a, median_b = (float(scale * norm.ppf(0.75)) for scale in (INTERCEPT_SCALE, SLOPE_SCALE))
    last = {"mode": start}

    def loss(log_noise: Array) -> float:
        sigma, omega = np.exp(log_noise)
        point = _point(margins, median_a, median_b, float(sigma), float(omega), last["mode"])
        last["mode"] = point.mode
        return -point.log_evidence + 0.5 * float((((log_noise - _NOISE_CENTRE) / _NOISE_SCALE) ** 2).sum())

    simplex = _NOISE_CENTRE + 0.3 * np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
    options = {"xatol": 0.01, "fatol": 0.01, "initial_simplex": simplex}
    noise = minimize(loss, simplex[0], method="Nelder-Mead", options=options)
    sigma, omega = (float(value) for value in np.exp(noise.x))
    taus = _half_normal_grid()
    points, mode = [], last["mode"]
    for tau_a, tau_b, weight in taus:
        point = _point(margins, tau_a, tau_b, sigma, omega, mode)
        points.append(replace(point, log_evidence=point.log_evidence + float(np.log(weight))))
        mode = point.mode
    return _population(margins, points, taus, sigma, omega)


def _population(
    margins: Margins, points: list[_Point], taus: list[tuple[float, float, float]], sigma: float, omega: float
) -> Population:
    p = margins.predictors.shape[1]
    grid = np.array([point.log_evidence for point in points])
    grid = grid - logsumexp(grid)
    weights = np.exp(grid)
    modes, covariances = np.array([q.mode for q in points]), np.array([q.covariance for q in points])
    between = np.array([_between(a, b, p) for a, b, _ in taus])
    means, errors = modes[:, -p:], covariances[:, -p:, -p:]
    nodes, node_weights = np.polynomial.hermite_e.hermegauss(_SPREAD_NODES)
    mean = weights @ means
    second = np.diagonal(errors, axis1=1, axis2=2) + means**2
    effects = _curvature(margins, weights @ modes, sigma, omega)
    prior = np.concatenate(([_MEAN_SCALE**2], np.full(p - 1, _MEAN_SLOPE_SCALE**2)))
    # Of the population's mean, if the coefficients of all siblings were known.
    least_errors = 1.0 / (margins.values.shape[1] / between + 1.0 / prior)
    diagonal = np.einsum("kp,pq->kpq", between, np.eye(p))
    twin = CoefficientMixture(
        log_weights=(grid[:, None] + np.log(node_weights / node_weights.sum())).ravel(),
        means=np.repeat(means, _SPREAD_NODES, axis=0),
        covariances=np.repeat(errors + diagonal, _SPREAD_NODES, axis=0),
        sigmas=np.tile(sigma * np.exp(SPREAD_SCALE * nodes), len(grid)),
        kinds=np.zeros(len(grid) * _SPREAD_NODES, np.intp),
    )
    least = np.einsum("kp,pq->kpq", least_errors, np.eye(p)) + diagonal
    return Population(
        twin=twin,
        limit=replace(twin, covariances=np.repeat(least, _SPREAD_NODES, axis=0)),
        siblings=modes[:, :-p],
        sibling_covariances=covariances[:, :-p, :-p],
        grid_weights=weights,
        mean=mean,
        mean_error=np.sqrt(np.maximum(weights @ second - mean**2, 0.0)),
        tau_intercept=float(weights @ [tau_a for tau_a, _, _ in taus]),
        tau_slope=float(weights @ [tau_b for _, tau_b, _ in taus]),
        sigma=sigma,
        omega=omega,
        effect_mean=effects.effect_mean,
        effect_variance=effects.effect_variance,
    )


def _half_normal_grid() -> list[tuple[float, float, float]]:
    """Values of tau_a and tau_b with the weights of their half-normal priors."""
    axes = []
    for scale, count in zip((INTERCEPT_SCALE, SLOPE_SCALE), _GRID, strict=True):
        nodes, weights = np.polynomial.legendre.leggauss(count)
        axes.append((scale * norm.ppf(0.75 + 0.25 * nodes), weights / 2.0))
    return [
        (float(a), float(b), float(u * v)) for a, u in zip(*axes[0], strict=True) for b, v in zip(*axes[1], strict=True)
    ]


def _between(tau_a: float, tau_b: float, p: int) -> Array:
    """(p,) variances of coefficients between simulators."""
    return np.concatenate(([tau_a**2], np.full(p - 1, tau_b**2)))


def _curvature(margins: Margins, state: Array, sigma: float, omega: float) -> Curvature:
    theta = state.reshape(-1, margins.predictors.shape[1])[:-1]
    return curvature_of(margins, margins.predictors @ theta.T, sigma, omega)


def _information(prior: Array, x: Array, tests: Array) -> Array:
    """Negative second derivatives by all coefficients, from those of each test by its linear predictors.

    The likelihood is log-concave (an integral of log-concave functions: Prekopa, 1973), so that no test has a negative
    curvature. Quadrature may say otherwise where sigma is much below omega; then each test's negative part is left out.
    """

    def total(of_tests: Array) -> Array:
        p, siblings = x.shape[1], of_tests.shape[1]
        blocks = np.einsum("np,nsz,nq->spzq", x, of_tests, x, optimize=True)
        information = prior.copy()
        information[:-p, :-p] += blocks.reshape(siblings * p, siblings * p)
        return information

    found = total(tests)
    try:
        np.linalg.cholesky(found)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(tests)
        return total(np.einsum("nik,nk,njk->nij", vectors, np.maximum(values, 0.0), vectors))
    return found


def _point(margins: Margins, tau_a: float, tau_b: float, sigma: float, omega: float, start: Array) -> _Point:
    """Find the mode of the coefficients by Newton's method, and approximate their posterior around it."""
    siblings, p = margins.values.shape[1], margins.predictors.shape[1]
    precision = 1.0 / _between(tau_a, tau_b, p)
    prior_mean = np.concatenate(([_MEAN_CENTRE], np.zeros(p - 1)))
    of_mean = 1.0 / np.concatenate(([_MEAN_SCALE**2], np.full(p - 1, _MEAN_SLOPE_SCALE**2)))
    links = np.vstack((np.hstack((np.eye(siblings), -np.ones((siblings, 1)))), np.zeros((1, siblings + 1))))
    prior = np.kron(links.T @ links, np.diag(precision))
    prior[-p:, -p:] += np.diag(of_mean)
    centre = np.tile(prior_mean, siblings + 1)  # the prior's mean, for siblings and population alike
    state = start

    def objective(at: Array) -> tuple[float, Curvature]:
        found = _curvature(margins, at, sigma, omega)
        return found.log_likelihood - 0.5 * float((at - centre) @ prior @ (at - centre)), found

    value, found = objective(state)
    x = margins.predictors
    for _ in range(_STEPS):
        gradient = -prior @ (state - centre)
        gradient[:-p] += (found.gradient.T @ x).ravel()
        information = _information(prior, x, found.information)
        step = np.linalg.solve(information, gradient)
        decrement = float(gradient @ step)
        if decrement < _CLOSE:
            break
        size = 1.0
        while size > 1e-6:
            tried, other = objective(state + size * step)
            if tried >= value:
                state, value, found = state + size * step, tried, other
                break
            size *= 0.5
        else:
            break
    log_prior = 0.5 * (siblings * float(np.log(precision).sum()) + float(np.log(of_mean).sum()))
    return _Point(
        log_evidence=value + log_prior - 0.5 * float(np.linalg.slogdet(information)[1]),
        mode=state,
        covariance=np.asarray(np.linalg.inv(information), np.float64),
    )
