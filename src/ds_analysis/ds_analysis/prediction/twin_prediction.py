"""Predicts a simulator that was never driven, or a car after a few drives, from the population of simulators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtr

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import Array, Indices
from ds_analysis.prediction.margins import INSIDE, Margins, margins_of
from ds_analysis.prediction.population import CoefficientMixture, Population, fit_population

DRAWS = 2000
"""Draws of the coefficients behind intervals; chosen: the ends of a 90 % interval are accurate to about 0.01."""
SEED = 17
"""Seed of those draws; any number does."""


@dataclass(frozen=True, kw_only=True)
class MarginDrive:
    """Outcome of one test on the simulator or car that is predicted.

    Attributes:
        row: row of the test.
        failed: whether the test failed.
        margin: margin of a completed run; None for a failed one, or if only the verdict is known.
    """

    row: int
    failed: bool
    margin: float | None = None

    @property
    def bound(self) -> float | None:
        """Bound of a margin that is not known: failed runs are above it, others below; None for a known margin."""
        if self.failed or self.margin is None:
            return 0.0
        return INSIDE if self.margin < INSIDE else None


@dataclass(frozen=True, kw_only=True, eq=False)
class TwinPrediction:
    """Prediction of every test of a table on one more simulator.

    Attributes:
        margins: margins of the siblings.
        population: posterior of the population.
        coefficients: distribution of the twin's coefficients, given the siblings and the twin's drives so far.
        drives: the twin's drives so far.
        log_evidence: logarithm of the probability of these drives, as predicted one after the other.
    """

    margins: Margins
    population: Population
    coefficients: CoefficientMixture
    drives: tuple[MarginDrive, ...] = ()
    log_evidence: float = 0.0

    def probabilities(self) -> Array:
        """(tests,) probability of failure."""
        mixture, predictors = self.coefficients, self.margins.predictors
        found = np.zeros(len(predictors))
        for weight, mean, covariance, sigma in zip(
            mixture.weights, mixture.means, mixture.covariances, mixture.sigmas, strict=True
        ):
            if weight > _NEGLIGIBLE:
                variance = np.einsum("np,pq,nq->n", predictors, covariance, predictors, optimize=True)
                variance += self.population.effect_variance + sigma**2
                found += weight * ndtr((predictors @ mean + self.population.effect_mean) / np.sqrt(variance))
        return self._with_drives(np.clip(found, 0.0, 1.0))

    def draws(self, count: int = DRAWS, *, rows: Indices | None = None, outcomes: bool = True) -> Array:
        """(count, tests) probabilities of failure, each row for one draw of the coefficients; the same on every call.

        Given the coefficients, outcomes of different tests are independent.

        Args:
            count: number of draws.
            rows: tests; all if None.
            outcomes: let driven tests have the probability 0 or 1, as they turned out.
        """
        mixture = self.coefficients
        rng = np.random.default_rng(SEED)
        # Systematic draws of the components: each comes as often as its weight says, but for rounding.
        chosen = np.searchsorted(np.cumsum(mixture.weights), (np.arange(count) + rng.random()) / count)
        chosen = np.minimum(chosen, len(mixture.weights) - 1)
        normal = rng.standard_normal((count, mixture.means.shape[1]))
        used, index = np.unique(chosen, return_inverse=True)
        roots = np.array([_root(mixture.covariances[k]) for k in used])
        theta = mixture.means[chosen] + np.einsum("mpq,mq->mp", roots[index], normal)
        rows = np.arange(len(self.margins.predictors)) if rows is None else rows
        found = theta @ self.margins.predictors[rows].T
        found += self.population.effect_mean[rows]
        for some, sigma in zip(found, mixture.sigmas[chosen], strict=True):
            some /= np.sqrt(self.population.effect_variance[rows] + sigma**2)
        ndtr(found, out=found)
        return self._with_drives(found, rows) if outcomes else found

    def updated(self, drives: Sequence[MarginDrive]) -> TwinPrediction:
        """Add drives of the twin; the population stays as the siblings say.

        A known margin updates every component of the mixture exactly; one of which only a bound is known
        by its first two moments (assumed density filtering), drives in the order of their tests.
        """
        mixture, evidence = self.coefficients, self.log_evidence
        for drive in sorted(drives, key=lambda one: one.row):
            mixture, gained = self._updated_by(mixture, drive)
            evidence += gained
        known = (*self.drives, *sorted(drives, key=lambda one: one.row))
        return replace(self, coefficients=mixture, drives=known, log_evidence=evidence)

    def _updated_by(self, mixture: CoefficientMixture, drive: MarginDrive) -> tuple[CoefficientMixture, float]:
        x = self.margins.predictors[drive.row]
        across = mixture.covariances @ x
        mean = mixture.means @ x + self.population.effect_mean[drive.row]
        variance = across @ x + self.population.effect_variance[drive.row] + mixture.sigmas**2
        log_density, moved, shrunk = _observation(drive, mean, variance)
        gain = across / variance[:, None]
        log_weights = mixture.log_weights + log_density
        total = float(logsumexp(log_weights))
        return CoefficientMixture(
            log_weights=log_weights - total,
            means=mixture.means + gain * moved[:, None],
            covariances=mixture.covariances - (1.0 - shrunk)[:, None, None] * gain[:, :, None] * across[:, None, :],
            sigmas=mixture.sigmas,
        ), total

    def _with_drives(self, probabilities: Array, rows: Indices | None = None) -> Array:
        """Replace the probabilities of driven tests by their outcomes."""
        place = {int(row): k for k, row in enumerate(range(probabilities.shape[-1]) if rows is None else rows)}
        for drive in self.drives:
            if drive.row in place:
                probabilities[..., place[drive.row]] = float(drive.failed)
        return probabilities


_NEGLIGIBLE = 1e-9
"""Weight of a component that is left out of sums; all of them together change no shown digit."""


def predict_twin(table: OutcomeTable) -> TwinPrediction:
    """Predict a simulator that was never driven from a table's siblings; the twin's outcomes are not looked at.

    Raises:
        ds_analysis.common.outcome_table.OutcomeTableError: too few tests.
    """
    margins = margins_of(table)
    population = fit_population(margins)
    return TwinPrediction(margins=margins, population=population, coefficients=population.twin)


def _root(covariance: Array) -> Array:
    """Square root of a covariance, which rounding may have made slightly indefinite."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _observation(drive: MarginDrive, mean: Array, variance: Array) -> tuple[Array, Array, Array]:
    """What a drive says about a margin with a normal prediction.

    Returns:
        Log probability (density); how far the margin's mean moves; the share of its variance that is left.
    """
    deviation = np.sqrt(variance)
    bound = drive.bound
    if bound is None:
        off = float(drive.margin or 0.0) - mean
        log_density = -0.5 * (off**2 / variance + np.log(2.0 * np.pi * variance))
        return log_density, off, np.zeros_like(mean)
    sign = 1.0 if drive.failed else -1.0
    standard = sign * (mean - bound) / deviation
    log_probability = log_ndtr(standard)
    hazard = np.exp(-0.5 * standard**2 - 0.5 * np.log(2.0 * np.pi) - log_probability)
    return np.asarray(log_probability), sign * deviation * hazard, 1.0 - hazard * (hazard + standard)


ODDS = 20.0
"""Ratio of the probabilities of the drives from which a car is said to be outside. If it is inside, this happens with a
probability of 1 / 20 at most, however many drives are looked at (Ville's inequality for likelihood ratios)."""
_BLENDS = 256
"""Blends of siblings; chosen: with three siblings, weights a twentieth apart."""
_BLEND_SEED = 21
"""Seed of the blends; any number does."""


@dataclass(frozen=True, kw_only=True)
class Span:
    """How the drives compare with what the siblings span.

    Attributes:
        drives: number of drives.
        odds: probability of the drives if the car is one more draw from the population, over that if it is a blend of
            the siblings.
        shift: mean margin of all tests as predicted after the drives, minus that of the most extreme sibling on the
            same side: how much further out the car drives than any of them (negative: further in), as a logarithm of
            lateral positions; 0 if it lies between them.
    """

    drives: int
    odds: float
    shift: float

    @property
    def outside(self) -> bool:
        """Whether the car is outside of what the siblings span."""
        return self.odds > ODDS

    @property
    def warning(self) -> str:
        """One line if the car is outside, or ""."""
        if not self.outside:
            return ""
        side = {1: ", further from its lane's centre than any of them", -1: ", closer to its lane's centre than any"}
        return (
            f"the car is outside of what the siblings span{side.get(int(np.sign(self.shift)), '')} "
            f"({self.odds:.0f} : 1 after {self.drives} drives): trust the drives more than the simulators"
        )

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "drives": self.drives, "odds": self.odds, "shift": self.shift, "outside": self.outside,
            "warning": self.warning,
        }  # fmt: skip


def span_of(prediction: TwinPrediction) -> Span:
    """Compare the drives of a prediction with the siblings."""
    if not prediction.drives:
        return Span(drives=0, odds=1.0, shift=0.0)
    blended = replace(prediction, coefficients=_blends(prediction), drives=(), log_evidence=0.0)
    inside = blended.updated(prediction.drives).log_evidence
    predictors = prediction.margins.predictors.mean(axis=0)
    mixture = prediction.coefficients
    car = float(mixture.weights @ (mixture.means @ predictors))
    siblings = prediction.population.sibling_means @ predictors
    beyond = max(car - float(siblings.max()), 0.0) + min(car - float(siblings.min()), 0.0)
    log_odds = min(prediction.log_evidence - inside, 100.0)
    return Span(drives=len(prediction.drives), odds=float(np.exp(log_odds)), shift=beyond)


def _blends(prediction: TwinPrediction) -> CoefficientMixture:
    """Coefficients that are weighted means of the siblings', all weights equally likely."""
    population = prediction.population
    p = len(population.mean)
    siblings = population.siblings.shape[1] // p
    mean = population.grid_weights @ population.siblings
    off = population.siblings - mean
    covariance = np.einsum("k,kij->ij", population.grid_weights, population.sibling_covariances)
    covariance += np.einsum("k,ki,kj->ij", population.grid_weights, off, off)
    weights = np.random.default_rng(_BLEND_SEED).dirichlet(np.ones(siblings), _BLENDS)
    blocks = covariance.reshape(siblings, p, siblings, p)
    return CoefficientMixture(
        log_weights=np.full(_BLENDS, -np.log(_BLENDS)),
        means=weights @ mean.reshape(siblings, p),
        covariances=np.einsum("ms,spzq,mz->mpq", weights, blocks, weights, optimize=True),
        sigmas=np.full(_BLENDS, population.sigma),
    )
