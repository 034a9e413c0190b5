# SPDX-License-Identifier: Apache-2.0
"""Experts that predict which tests a car fails: logistic regressions with a normal prior, and a plain failure rate.

A prior's mean is what the siblings' outcomes say, each sibling predicted from the others; its spread says how far a car
may lie from them. Evidence of drives is Laplace's approximation (MacKay, Neural Computation 1992, 4(3)), probabilities
are the probit approximation with the coefficients' covariance (MacKay, Neural Computation 1992, 4(5)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import betaln, expit, log_expit, logit

from ds_analysis.common.statistics import Array, Bools, Indices

LEVEL_SPREADS = (1.0, 3.0)
"""Spreads of a car's level around the siblings', logits, an expert each; chosen: like its siblings, and any rate."""
SLOPE_SPREAD = 0.5
"""Spread of its slopes around the siblings', per standard deviation of a feature; chosen: half of a slope."""
OWN_LEVEL_SPREAD, OWN_SLOPE_SPREAD = 3.0, 1.0
"""The same around zero, for a car that follows no sibling."""
RIDGE, LEVEL_RIDGE = 1.0, 0.1
"""Precisions of slopes' and levels' priors in fits of siblings; chosen: weak, but every slope stays finite."""
FARTHEST_INSIDE = -2.0
"""Least margin that counts; chosen: a seventh of the limit, below which how far inside a run stays says nothing."""
UNKNOWN_MARGIN = -1.0
"""Margin of a completed run of which only the verdict is known."""
_LEAST_SCALE = 0.3
"""Spread below which what siblings say is not magnified."""
_STEPS, _LONGEST_STEP, _TOLERANCE = 30, 3.0, 1e-6


def fit_logistic(design: Array, failed: Array, mean: Array, precision: Array) -> tuple[Array, Array, float]:
    """Fit a logistic regression on (tests, p) predictors with independent normal priors by Newton's method.

    Returns of the coefficients' posterior the (p,) mode and (p, p) covariance, and the outcomes' log evidence.
    """
    mode = mean.copy()
    for _ in range(_STEPS):
        probability = expit(design @ mode)
        curvature = (design.T * (probability * (1.0 - probability))) @ design + np.diag(precision)
        step = np.linalg.solve(curvature, design.T @ (failed - probability) - precision * (mode - mean))
        mode = mode + step / max(1.0, float(np.abs(step).max()) / _LONGEST_STEP)
        if np.abs(step).max() < _TOLERANCE:
            break
    linear = design @ mode
    probability = expit(linear)
    curvature = (design.T * (probability * (1.0 - probability))) @ design + np.diag(precision)
    log_posterior = failed @ log_expit(linear) + (1.0 - failed) @ log_expit(-linear)
    log_posterior -= 0.5 * precision @ (mode - mean) ** 2
    evidence = log_posterior + 0.5 * np.log(precision).sum() - 0.5 * np.linalg.slogdet(curvature)[1]
    return mode, np.linalg.inv(curvature), float(evidence)


@dataclass(frozen=True, eq=False)
class LearntLogistic:
    """What a logistic expert believes after some drives; posterior and evidence are as of `fit_logistic`."""

    design: Array
    mode: Array
    covariance: Array
    log_evidence: float

    def probabilities(self, rows: Indices) -> Array:
        """(rows,) probabilities of failure."""
        x = self.design[rows]
        variance = np.einsum("ij,jk,ik->i", x, self.covariance, x, optimize=True)
        return np.asarray(expit(x @ self.mode / np.sqrt(1.0 + np.pi * variance / 8.0)))

    def draws(self, rng: np.random.Generator, count: int, rows: Indices) -> Array:
        """(count, rows) probabilities of failure, each row for one draw of what is uncertain about the car."""
        coefficients = rng.multivariate_normal(self.mode, self.covariance, count, method="cholesky")
        return np.asarray(expit(coefficients @ self.design[rows].T))


@dataclass(frozen=True, eq=False)
class LogisticExpert:
    """Logistic regression on (tests, p) predictors; (p,) means and precisions of the coefficients' prior."""

    name: str
    uses_siblings: bool
    design: Array
    mean: Array
    precision: Array

    def after(self, rows: Indices, failed: Array) -> LearntLogistic:
        """Learn from the verdicts of drives, 1.0 where one failed."""
        if not len(rows):
            return LearntLogistic(self.design, self.mean, np.diag(1.0 / self.precision), 0.0)
        return LearntLogistic(self.design, *fit_logistic(self.design[rows], failed, self.mean, self.precision))


@dataclass(frozen=True)
class LearntRate:
    """Jeffreys' posterior of a failure rate; methods are as in `LearntLogistic`."""

    failures: float
    completed: float

    @property
    def log_evidence(self) -> float:
        """Logarithm of the drives' evidence."""
        return float(betaln(self.failures + 0.5, self.completed + 0.5) - betaln(0.5, 0.5))

    def probabilities(self, rows: Indices) -> Array:
        """(rows,) probabilities of failure."""
        return np.full(len(rows), (self.failures + 0.5) / (self.failures + self.completed + 1.0))

    def draws(self, rng: np.random.Generator, count: int, rows: Indices) -> Array:
        """(count, rows) probabilities of failure, a rate for each draw."""
        rates = rng.beta(self.failures + 0.5, self.completed + 0.5, count)
        return np.repeat(rates[:, None], len(rows), axis=1)


@dataclass(frozen=True)
class RateExpert:
    """The same probability for every test."""

    name: str = "rate"
    uses_siblings: bool = False

    def after(self, rows: Indices, failed: Array) -> LearntRate:
        """Learn from the verdicts of drives, 1.0 where one failed."""
        failures = float(failed.sum())
        return LearntRate(failures, len(rows) - failures)


Expert = LogisticExpert | RateExpert
Learnt = LearntLogistic | LearntRate


@dataclass(frozen=True, kw_only=True, eq=False)
class SiblingOutcomes:
    """What siblings did."""

    features: Array  # (tests, features) standardised
    failed: Bools  # (tests, siblings) whether a test failed
    known: Bools  # (tests, siblings) whether there is a verdict
    margins: Array  # (tests, siblings) logarithm of the largest lateral position over its limit; NaN if not known

    def of(self, siblings: Sequence[int]) -> SiblingOutcomes:
        """Keep some siblings."""
        kept = list(siblings)
        return replace(self, failed=self.failed[:, kept], known=self.known[:, kept], margins=self.margins[:, kept])

    def said(self) -> Array:
        """(tests, 1 or 2) smoothed log odds of the siblings' failures; their mean margin, where any is known."""
        count = self.known.sum(axis=1)
        odds = logit((self.failed.sum(axis=1) + 0.5) / (count + 1.0))
        if not np.isfinite(self.margins[self.known & ~self.failed]).any():
            return np.asarray(odds[:, None])
        margins = np.where(np.isfinite(self.margins), self.margins, UNKNOWN_MARGIN)
        margins = np.where(self.failed, 0.0, np.clip(margins, FARTHEST_INSIDE, 0.0))
        mean = np.where(self.known, margins, 0.0).sum(axis=1) / np.maximum(count, 1)
        return np.column_stack((odds, np.where(count > 0, mean, mean[count > 0].mean())))


def experts_of(outcomes: SiblingOutcomes) -> list[Expert]:
    """Make the experts for one more simulator: three that use the siblings, at each spread of levels, two that do not.

    Slopes are common to the siblings, each with a level of its own; a sibling is predicted from what the others did. Of
    a single sibling, whom no other predicts, the word counts half.
    """
    features, count = outcomes.features, outcomes.failed.shape[1]
    whole = outcomes.said()
    others = [outcomes.of([k for k in range(count) if k != one]).said() for one in range(count)] if count > 1 else []
    width = min(one.shape[1] for one in (whole, *others))  # margins count where every one has them
    centre, scale = whole[:, :width].mean(axis=0), np.maximum(whole[:, :width].std(axis=0), _LEAST_SCALE)
    heard, *heard_of_others = ((one[:, :width] - centre) / scale for one in (whole, *others))
    experts: list[Expert] = []
    alone = _pooled(outcomes, [features] * count)
    for name, own, hears in (
        ("features", features, False),
        ("features and siblings", features, True),
        ("siblings", features[:, :0], True),
    ):
        predictors = np.hstack((own, heard)) if hears else own
        if not hears:
            mean, variance = alone
        elif others:
            mean, variance = _pooled(outcomes, [np.hstack((own, one)) for one in heard_of_others])
        else:
            level = alone[0][:1] if own.size else [logit((outcomes.failed.sum() + 0.5) / (outcomes.known.sum() + 1.0))]
            halved = 0.5 * alone[0][1 : own.shape[1] + 1]
            mean = np.concatenate((level, halved, [0.25 if own.size else 0.5], np.zeros(width - 1)))
            variance = np.zeros(len(mean))
        experts += [_logistic(name, predictors, mean, variance, spread) for spread in LEVEL_SPREADS]
    design = np.column_stack((np.ones(len(features)), features))
    spreads = np.array([OWN_LEVEL_SPREAD, *[OWN_SLOPE_SPREAD] * features.shape[1]])
    experts.append(LogisticExpert("own features", False, design, np.zeros(len(spreads)), 1.0 / spreads**2))
    return [*experts, RateExpert()]


def _pooled(outcomes: SiblingOutcomes, predictors: Sequence[Array]) -> tuple[Array, Array]:
    """Mean level and common slopes of the siblings, each with (tests, p) predictors of its own, and their variances."""
    count, width = len(predictors), predictors[0].shape[1]
    designs, failed = [], []
    for one, own in enumerate(predictors):
        rows = outcomes.known[:, one]
        levels = np.zeros((int(rows.sum()), count))
        levels[:, one] = 1.0
        designs.append(np.hstack((levels, own[rows])))
        failed.append(outcomes.failed[rows, one].astype(np.float64))
    precision = np.concatenate((np.full(count, LEVEL_RIDGE), np.full(width, RIDGE)))
    mode, covariance, _ = fit_logistic(np.vstack(designs), np.concatenate(failed), np.zeros(count + width), precision)
    combine = np.vstack((np.repeat([1.0 / count, 0.0], [count, width]), np.eye(width, count + width, count)))
    return combine @ mode, np.diag(combine @ covariance @ combine.T)


def _logistic(name: str, predictors: Array, mean: Array, variance: Array, spread: float) -> LogisticExpert:
    """An expert around the siblings: its prior is as wide as a car may differ, and as the siblings are uncertain."""
    design = np.column_stack((np.ones(len(predictors)), predictors))
    spreads = np.array([spread, *[SLOPE_SPREAD] * predictors.shape[1]])
    return LogisticExpert(name, True, design, mean, 1.0 / (spreads**2 + variance))
