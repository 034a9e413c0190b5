"""Whether a car behaves as the siblings span it: its drives, predicted from mixtures of siblings and as a new draw."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ds_analysis.prediction.population import CoefficientMixture
from ds_analysis.prediction.twin_prediction import TwinPrediction

ODDS = 20.0
"""Ratio of the probabilities of the drives from which a car is said to be outside. If it is inside, this happens with a
probability of 1 / 20 at most, however many drives are looked at (Ville's inequality for likelihood ratios)."""
_BLENDS = 256
"""Blends of siblings; chosen: with three siblings, weights a twentieth apart."""
_SEED = 21
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
    weights = np.random.default_rng(_SEED).dirichlet(np.ones(siblings), _BLENDS)
    blocks = covariance.reshape(siblings, p, siblings, p)
    return CoefficientMixture(
        log_weights=np.full(_BLENDS, -np.log(_BLENDS)),
        means=weights @ mean.reshape(siblings, p),
        covariances=np.einsum("ms,spzq,mz->mpq", weights, blocks, weights, optimize=True),
        sigmas=np.full(_BLENDS, population.sigma),
    )
