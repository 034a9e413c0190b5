"""Simulators as draws from a population: what three siblings say about a simulator, or a car, that was never driven.

Coefficients of simulator s (see `ds_orchestrator.prediction.margins`) are draws theta_s ~ N(beta, T), with T diagonal:
tau_a^2 for the intercept, tau_b^2 for every slope; log sigma_s ~ N(gamma, tau_s^2). The twin is one more draw, so its
boundary may lie outside of what the siblings span. With few siblings the between-simulator standard deviations are
hardly identified: they get weakly informative half-normal priors, and are integrated out over a grid; given them
everything is normal and exact (the nested integration of INLA: Rue, Martino, Chopin, J. R. Stat. Soc. B 2009, and of
bayesmeta: Roever, J. Stat. Softw. 2020). The result is a mixture of normals, without random numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import norm

from ds_orchestrator.prediction.margins import Likelihood

Array = NDArray[np.float64]

INTERCEPT_SCALE = 0.5
"""Scale of the half-normal prior of tau_a: of the sizes that Roever et al. (Res. Synth. Methods 2021, section 4)
recommend for logarithms of ratios; simulators' typical lateral positions then differ by a factor of 2.7 at most (one
standard deviation either way) in two of three populations."""
SLOPE_SCALE = 0.25
"""Scale of the half-normal prior of tau_b, for standardised features: half of `INTERCEPT_SCALE`, so that at a feature
two standard deviations from its mean a slope matters as much as the intercept."""
SPREAD_SCALE = 0.25
"""Scale of the half-normal prior of tau_s: residual spreads of simulators within a factor of 1.6 of each other; chosen,
as `SLOPE_SCALE`."""
_MEAN_CENTRE, _MEAN_SCALE = np.log(0.25), 1.0
"""Prior of the population's mean margin of a typical test: 3 % to 180 % of half a lane (two standard deviations)."""
_SLOPE_SCALE_OF_MEAN = 1.0
"""Standard deviation of the population's mean slopes: lateral positions that a feature multiplies by up to 7 from one
standard deviation to the next."""
_GRID = 12
"""Values of each between-simulator standard deviation: midpoints of as many equally probable parts of its prior."""
_SPREAD_NODES = 5
"""Gauss-Hermite nodes of the twin's log sigma."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CoefficientMixture:
    """Distribution of a simulator's coefficients: a mixture of normals.

    Attributes:
        log_weights: (k,) logarithms of the weights, which sum to 1.
        means: (k, p) means of the coefficients.
        covariances: (k, p, p) their covariances.
        sigmas: (k,) residual standard deviations.
    """

    log_weights: Array
    means: Array
    covariances: Array
    sigmas: Array

    @property
    def weights(self) -> Array:
        """(k,) weights."""
        return np.asarray(np.exp(self.log_weights))


@dataclass(frozen=True, kw_only=True, eq=False)
class Population:
    """Posterior of the population and of one more simulator.

    Attributes:
        twin: coefficients of a simulator that was never driven.
        mean: (p,) posterior mean of the population's mean coefficients.
        mean_error: (p,) posterior standard deviations of those.
        tau_intercept: posterior mean of tau_a.
        tau_slope: posterior mean of tau_b.
    """

    twin: CoefficientMixture
    mean: Array
    mean_error: Array
    tau_intercept: float
    tau_slope: float

    def document(self) -> dict[str, Any]:
        """Convert to JSON values; coefficients belong to a 1 and the standardised features."""
        return {
            "mean": self.mean.tolist(),
            "mean_error": self.mean_error.tolist(),
            "tau_intercept": self.tau_intercept,
            "tau_slope": self.tau_slope,
        }


def fit_population(likelihood: Likelihood) -> Population:
    """Integrate the population out; deterministic, in milliseconds."""
    siblings, p = likelihood.mode.shape
    taus = _half_normal_nodes(INTERCEPT_SCALE), _half_normal_nodes(SLOPE_SCALE)
    prior_mean = np.concatenate(([_MEAN_CENTRE], np.zeros(p - 1)))
    of_mean = np.diag(np.concatenate(([_MEAN_SCALE**2], np.full(p - 1, _SLOPE_SCALE_OF_MEAN**2))))
    groups = siblings + 2  # siblings, the twin, and the population's mean itself
    size, driven = groups * p, siblings * p
    shift = np.tile(prior_mean, siblings)
    linear = np.zeros(size)
    linear[:driven] = likelihood.linear - likelihood.information @ shift
    information = np.zeros((size, size))
    information[:driven, :driven] = likelihood.information
    log_weights, means, covariances = [], [], []
    own = np.diag(np.concatenate((np.ones(siblings + 1), [0.0])))
    for tau_a in taus[0]:
        for tau_b in taus[1]:
            between = np.diag(np.concatenate(([tau_a**2], np.full(p - 1, tau_b**2))))
            prior = np.kron(np.ones((groups, groups)), of_mean) + np.kron(own, between)
            # (information + prior^-1)^-1 without inverting the prior, which may be singular.
            inner = np.eye(size) + information @ prior
            covariance = prior @ np.linalg.inv(inner)
            mean = covariance @ linear
            log_weights.append(0.5 * float(linear @ mean) - 0.5 * float(np.linalg.slogdet(inner)[1]))
            means.append(mean[driven:] + np.tile(prior_mean, 2))
            covariances.append((covariance + covariance.T)[driven:, driven:] / 2.0)
    grid = np.array(log_weights) - logsumexp(log_weights)
    weights, mean, covariance = np.exp(grid), np.array(means), np.array(covariances)
    sigmas, sigma_weights = _spread_nodes(likelihood)
    of_mean_mean = weights @ mean[:, p:]
    second = np.diagonal(covariance[:, p:, p:], axis1=1, axis2=2) + mean[:, p:] ** 2
    by_tau = weights.reshape(_GRID, _GRID)
    return Population(
        twin=CoefficientMixture(
            log_weights=(grid[:, None] + np.log(sigma_weights)).ravel(),
            means=np.repeat(mean[:, :p], _SPREAD_NODES, axis=0),
            covariances=np.repeat(covariance[:, :p, :p], _SPREAD_NODES, axis=0),
            sigmas=np.tile(sigmas, len(grid)),
        ),
        mean=of_mean_mean,
        mean_error=np.sqrt(np.maximum(weights @ second - of_mean_mean**2, 0.0)),
        tau_intercept=float(by_tau.sum(axis=1) @ taus[0]),
        tau_slope=float(by_tau.sum(axis=0) @ taus[1]),
    )


def _half_normal_nodes(scale: float) -> Array:
    """Midpoints of `_GRID` equally probable parts of a half-normal distribution."""
    return np.asarray(scale * norm.ppf(0.5 + 0.5 * (np.arange(_GRID) + 0.5) / _GRID))


def _spread_nodes(likelihood: Likelihood) -> tuple[Array, Array]:
    """Residual standard deviations of the twin and their weights: another draw from the siblings' population."""
    values, errors = likelihood.log_sigma, likelihood.log_sigma_error
    log_weights, means, variances = [], [], []
    for tau in _half_normal_nodes(SPREAD_SCALE):
        precision = 1.0 / (errors**2 + tau**2)
        mean = float(precision @ values / precision.sum())
        log_weights.append(
            0.5 * float(np.log(precision).sum() - np.log(precision.sum()) - precision @ (values - mean) ** 2)
        )
        means.append(mean)
        variances.append(1.0 / precision.sum() + tau**2)
    weights = np.exp(np.array(log_weights) - logsumexp(log_weights))
    centre = float(weights @ means)
    spread = float(np.sqrt(weights @ (np.array(variances) + np.array(means) ** 2) - centre**2))
    nodes, node_weights = np.polynomial.hermite_e.hermegauss(_SPREAD_NODES)
    return np.exp(centre + spread * nodes), node_weights / node_weights.sum()
