"""Latent margins of tests on the siblings: a censored linear model with an effect that all simulators share.

The margin of test i on simulator s is the logarithm of the largest absolute lateral position over half a lane: 0 at
the lane's edge, where a test fails. It is

    margin_is = x_i . theta_s + t_i + e_is,    t_i ~ N(0, omega^2),    e_is ~ N(0, sigma^2)

with features x_i (a 1 first), coefficients theta_s of each simulator, and a test effect t_i: what is hard about a test
on every simulator and not said by its features. A failed run ends at the lane's edge: its margin is only known to be
above 0. A run well within its lane says that its margin is below `INSIDE`, and no more: how a car keeps to an easy lane
does not tell where it loses a hard one. Margins between are known (a doubly censored, or Tobit, regression: Tobin,
Econometrica 1958). The test effects are integrated out: in closed form over known margins, and by Gauss-Hermite
quadrature over censored ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError, State
from ds_analysis.common.statistics import Array, Bools

INSIDE = float(np.log(0.5))
"""Margin below which a run is well within its lane: half of half a lane, 1 m. From there on a car 1.8 m wide, as a
middle-class one is, has its wheels at the line."""
FEWEST_TESTS = 10
"""Tests with a verdict on some sibling that a fit needs; chosen: the population's prior makes up for small numbers, but
features cannot be standardised over a handful."""
_NODES, _NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
_LOG_WEIGHTS = np.log(_NODE_WEIGHTS) - 0.5 * np.log(2.0 * np.pi)
_LOG_ROOT = 0.5 * float(np.log(2.0 * np.pi))


@dataclass(frozen=True, kw_only=True, eq=False)
class Margins:
    """What is known about margins of tests on siblings.

    Attributes:
        predictors: (tests, p) a 1, then the standardised features.
        values: (tests, siblings) known margins, or the bounds of censored ones; 0 elsewhere.
        signs: (tests, siblings) 1 where the margin is above its bound, -1 where it is below, 0 where it is known.
        driven: (tests, siblings) whether there is a verdict.
    """

    predictors: Array
    values: Array
    signs: NDArray[np.int8]
    driven: Bools


@dataclass(frozen=True, kw_only=True, eq=False)
class Curvature:
    """Log likelihood of margins at some linear predictors, with test effects integrated out.

    Attributes:
        log_likelihood: sum over tests.
        gradient: (tests, siblings) derivatives by the linear predictors.
        information: (tests, siblings, siblings) negative second derivatives by them.
        effect_mean: (tests,) posterior means of the test effects.
        effect_variance: (tests,) their posterior variances.
    """

    log_likelihood: float
    gradient: Array
    information: Array
    effect_mean: Array
    effect_variance: Array


def margins_of(table: OutcomeTable) -> Margins:
    """Compute the margins of a table's tests on its siblings.

    Raises:
        OutcomeTableError: too few tests.
    """
    columns = [table.column(name) for name in table.siblings]
    states = table.states[:, columns]
    failed, completed = states == State.FAILED, states == State.COMPLETED
    driven = failed | completed
    tests = driven.any(axis=1)
    if tests.sum() < FEWEST_TESTS:
        raise OutcomeTableError(
            f"{int(tests.sum())} tests have a verdict on a sibling, expected at least {FEWEST_TESTS}: drive more tests"
        )
    for name, known in zip(table.siblings, driven.any(axis=0), strict=True):
        if not known:
            raise OutcomeTableError(f"no test has a verdict on {name}: drive tests there, or leave it out")
    centre, scale = table.features[tests].mean(axis=0), table.features[tests].std(axis=0)
    scale = np.where(scale > 1e-12, scale, 1.0)
    values = margin(table.lateral[:, columns], table.limits[:, columns])
    inside, unknown = completed & (values < INSIDE), completed & np.isnan(values)
    return Margins(
        predictors=np.column_stack((np.ones(len(table)), (table.features - centre) / scale)),
        values=np.where(inside, INSIDE, np.where(completed & ~unknown, values, 0.0)),
        signs=np.where(failed, 1, np.where(inside | unknown, -1, 0)).astype(np.int8),
        driven=driven,
    )


def margin(lateral: Array, limits: Array) -> Array:
    """Margin of largest absolute lateral positions, m: 0 at the lane's edge, negative within the lane."""
    return np.asarray(np.log(np.maximum(lateral, 1e-3 * limits) / limits))


def curvature_of(margins: Margins, linear: Array, sigma: float, omega: float) -> Curvature:
    """Integrate the test effects out.

    Derivatives are posterior moments, over the test effect, of the derivatives with a known effect (Louis, J. R. Stat.
    Soc. B 1982).

    Args:
        margins: of the tests.
        linear: (tests, siblings) linear predictors x_i . theta_s.
        sigma: residual standard deviation.
        omega: standard deviation of the test effects.
    """
    known = margins.driven & (margins.signs == 0)
    residual = np.where(known, margins.values - linear, 0.0)
    count = known.sum(axis=1)
    variance = 1.0 / (1.0 / omega**2 + count / sigma**2)
    mean = variance * residual.sum(axis=1) / sigma**2
    value = 0.5 * np.log(variance / omega**2) + 0.5 * mean**2 / variance
    value -= count * (np.log(sigma) + _LOG_ROOT) + 0.5 * (residual**2).sum(axis=1) / sigma**2
    effect = mean[:, None] + np.sqrt(variance)[:, None] * _NODES
    # Derivatives by the linear predictors at the nodes: (tests, nodes, siblings).
    first = np.where(known[:, None, :], (residual[:, None, :] - effect[:, :, None]) / sigma**2, 0.0)
    second = np.repeat((known / sigma**2)[:, None, :], len(_NODES), axis=1)
    tests, on = np.nonzero(margins.signs)
    sign = margins.signs[tests, on][:, None].astype(np.float64)
    standard = sign * (linear[tests, on][:, None] + effect[tests] - margins.values[tests, on][:, None]) / sigma
    log_phi = log_ndtr(standard)
    hazard = np.exp(-0.5 * standard**2 - _LOG_ROOT - log_phi)
    first[tests, :, on] = sign * hazard / sigma
    second[tests, :, on] = hazard * (hazard + standard) / sigma**2
    log_terms = np.repeat(_LOG_WEIGHTS[None], len(linear), axis=0)
    np.add.at(log_terms, tests, log_phi)
    top = log_terms.max(axis=1)
    weights = np.exp(log_terms - top[:, None])
    total = weights.sum(axis=1)
    weights /= total[:, None]
    gradient = np.einsum("nq,nqs->ns", weights, first)
    centred = first - gradient[:, None, :]
    information = -np.einsum("nq,nqs,nqz->nsz", weights, centred, centred, optimize=True)
    index = np.arange(linear.shape[1])
    information[:, index, index] += np.einsum("nq,nqs->ns", weights, second)
    after = (weights * effect).sum(axis=1)
    return Curvature(
        log_likelihood=float((value + top + np.log(total)).sum()),
        gradient=gradient,
        information=information,
        effect_mean=after,
        effect_variance=(weights * (effect - after[:, None]) ** 2).sum(axis=1),
    )
