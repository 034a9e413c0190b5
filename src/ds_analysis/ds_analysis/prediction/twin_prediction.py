"""Predicts a simulator that was never driven, or a car after a few drives, from the population of simulators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtr

from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError
from ds_analysis.common.statistics import Array, Indices
from ds_analysis.prediction.margins import INSIDE, Margins, margin, margins_of
from ds_analysis.prediction.population import KINDS, CoefficientMixture, Population, fit_population

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
        in_turn: sibling -> weights of its kinds (`KINDS`), as its outcomes tell when the others predict it.
    """

    margins: Margins
    population: Population
    coefficients: CoefficientMixture
    drives: tuple[MarginDrive, ...] = ()
    log_evidence: float = 0.0
    in_turn: Mapping[str, Sequence[float]] = field(default_factory=dict)

    @property
    def alike(self) -> float:
        """Probability that the twin is one more simulator like the siblings."""
        return float(self.coefficients.shares[0])

    @property
    def kinds_sentence(self) -> str:
        """What is known of the twin's kind, in one line."""
        named = [f"{name} {KINDS[int(np.argmax(shares))]}" for name, shares in self.in_turn.items()]
        seen = f"Each simulator predicted from the others: {', '.join(named)}; the" if named else "The"
        drives = f" after {len(self.drives)} drives" if self.drives else ""
        return f"{seen} car is taken to be like them with a probability of {self.alike:.2f}{drives}."

    def document_of_kinds(self) -> dict[str, Any]:
        """Convert what is known of kinds to JSON values."""
        shares = dict(zip(KINDS, map(float, self.coefficients.shares), strict=True))
        return {"car": shares, "in_turn": {name: list(one) for name, one in self.in_turn.items()}}

    def probabilities(self) -> Array:
        """(tests,) probability of failure."""
        mixture, predictors = self.coefficients, self.margins.predictors
        effects, unknown = self._effects(np.arange(len(predictors)))
        found = np.zeros(len(predictors))
        for weight, mean, covariance, sigma, kind in zip(
            mixture.weights, mixture.means, mixture.covariances, mixture.sigmas, mixture.kinds, strict=True
        ):
            if weight > _NEGLIGIBLE:
                variance = np.einsum("np,pq,nq->n", predictors, covariance, predictors, optimize=True)
                variance += unknown[kind] + sigma**2
                found += weight * ndtr((predictors @ mean + effects[kind]) / np.sqrt(variance))
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
        effects, unknown = self._effects(rows)
        for some, sigma, kind in zip(found, mixture.sigmas[chosen], mixture.kinds[chosen], strict=True):
            some += effects[kind]
            some /= np.sqrt(unknown[kind] + sigma**2)
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
        effects, unknown = (one[:, 0] for one in self._effects(np.array([drive.row])))
        mean = mixture.means @ x + effects[mixture.kinds]
        variance = across @ x + unknown[mixture.kinds] + mixture.sigmas**2
        log_density, moved, shrunk = _observation(drive, mean, variance)
        gain = across / variance[:, None]
        log_weights = mixture.log_weights + log_density
        total = float(logsumexp(log_weights))
        return CoefficientMixture(
            log_weights=log_weights - total,
            means=mixture.means + gain * moved[:, None],
            covariances=mixture.covariances - (1.0 - shrunk)[:, None, None] * gain[:, :, None] * across[:, None, :],
            sigmas=mixture.sigmas,
            kinds=mixture.kinds,
        ), total

    def _effects(self, rows: Indices) -> tuple[Array, Array]:
        """(kinds, rows) means and variances of the test effects, which only simulators that are alike share."""
        mean, variance = np.zeros((len(KINDS), len(rows))), np.full((len(KINDS), len(rows)), self.population.omega**2)
        mean[0], variance[0] = self.population.effect_mean[rows], self.population.effect_variance[rows]
        return mean, variance

    def _with_drives(self, probabilities: Array, rows: Indices | None = None) -> Array:
        """Replace the probabilities of driven tests by their outcomes."""
        place = {int(row): k for k, row in enumerate(range(probabilities.shape[-1]) if rows is None else rows)}
        for drive in self.drives:
            if drive.row in place:
                probabilities[..., place[drive.row]] = float(drive.failed)
        return probabilities


_NEGLIGIBLE = 1e-9
"""Weight of a component that is left out of sums; all of them together change no shown digit."""


PSEUDO = (0.5, 0.25, 0.25)
"""Dirichlet prior of the shares of the kinds; chosen: as much as one simulator says, half of it for *alike*."""
EXCHANGEABLE = 0.5
"""Probability that the car is one more simulator of the siblings' kind of kinds; otherwise the prior alone counts, as
simulators that agree with each other may all miss the car; chosen: a coin."""
LEVEL_SCALE = 2.0
"""Standard deviation of the level of a simulator of an other level, in residual standard deviations: any rate."""


def predict_twin(table: OutcomeTable, *, in_turn: bool = True) -> TwinPrediction:
    """Predict a simulator that was never driven from a table's siblings; the twin's outcomes are not looked at.

    Of which kind it is (`KINDS`) is as uncertain as the siblings leave it: each of them is predicted from the others,
    and its outcomes say of which kind it is (`in_turn`; otherwise the prior alone counts).

    Raises:
        ds_analysis.common.outcome_table.OutcomeTableError: too few tests.
    """
    counts = np.array(PSEUDO)
    found: dict[str, Sequence[float]] = {}
    if in_turn and len(table.siblings) > 1:
        known = table.with_twin(None)
        for name in known.siblings:
            try:
                others = predict_twin(known.with_twin(name), in_turn=False)
            except OutcomeTableError:
                continue
            shares = others.updated(outcomes_of(table, name)).coefficients.shares
            found[name] = tuple(map(float, shares))
            counts += shares
    margins = margins_of(table)
    population = fit_population(margins)
    prior = np.array(PSEUDO) / sum(PSEUDO)
    shares = EXCHANGEABLE * counts / counts.sum() + (1.0 - EXCHANGEABLE) * prior
    mixture = of_any_kind(population, shares)
    return TwinPrediction(margins=margins, population=population, coefficients=mixture, in_turn=found)


def of_any_kind(population: Population, shares: Array) -> CoefficientMixture:
    """Mix what is known of a simulator that is alike with what is known of others; see `KINDS`.

    Args:
        population: posterior of the siblings' population.
        shares: (kinds,) prior probabilities of the kinds.
    """
    alike = population.twin
    spread = float(np.hypot(population.sigma, population.omega))
    mean = alike.weights @ alike.means
    off = alike.means - mean
    covariance = np.einsum("k,kij->ij", alike.weights, alike.covariances)
    covariance += np.einsum("k,ki,kj->ij", alike.weights, off, off)
    covariance[0, :] = covariance[:, 0] = 0.0
    covariance[0, 0] = (LEVEL_SCALE * spread) ** 2
    nothing = np.zeros_like(covariance)
    nothing[0, 0] = spread**2  # so that any failure rate is equally likely
    sigma = population.sigma
    return CoefficientMixture(
        log_weights=np.concatenate((alike.log_weights + np.log(shares[0]), np.log(shares[1:]))),
        means=np.vstack((alike.means, mean, np.zeros_like(mean))),
        covariances=np.concatenate((alike.covariances, covariance[None], nothing[None])),
        sigmas=np.concatenate((alike.sigmas, [sigma, sigma])),
        kinds=np.concatenate((alike.kinds, [1, 2])),
    )


def outcomes_of(table: OutcomeTable, name: str) -> list[MarginDrive]:
    """Return all outcomes of a simulator, as if they were its drives."""
    column, failed = table.column(name), table.failed(name)
    margins = margin(table.lateral[:, column], table.limits[:, column])
    return [
        MarginDrive(
            row=int(row),
            failed=bool(failed[row]),
            margin=None if failed[row] or np.isnan(margins[row]) else float(margins[row]),
        )
        for row in np.flatnonzero(table.known(name))
    ]


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
DOUBT = 0.2
"""Probability that a car is like the siblings below which a warning says so; chosen: four to one."""
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
        alike: probability that the car is one more simulator like the siblings.
    """

    drives: int
    odds: float
    shift: float
    alike: float = 1.0

    @property
    def outside(self) -> bool:
        """Whether the car is outside of what the siblings span."""
        return self.odds > ODDS

    @property
    def warning(self) -> str:
        """One line if the siblings do not predict the car, or it is outside of what they span, or ""."""
        said = []
        if self.drives and self.alike < DOUBT:
            said.append(f"these simulators do not predict this car (like them with a probability of {self.alike:.2f})")
        if self.outside:
            side = {
                1: ", further from its lane's centre than any of them",
                -1: ", closer to its lane's centre than any",
            }
            where = side.get(int(np.sign(self.shift)), "")
            odds = f"{self.odds:.0f} : 1" if self.odds < 1000.0 else "more than 1000 : 1"
            said.append(f"the car is outside of what the siblings span{where} ({odds})")
        drives = f"after {self.drives} drives" if self.drives > 1 else "after a drive"
        return f"{', and '.join(said)} {drives}: trust the drives more than the simulators" if said else ""

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "drives": self.drives, "odds": self.odds, "shift": self.shift, "alike": self.alike, "outside": self.outside,
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
    return Span(drives=len(prediction.drives), odds=float(np.exp(log_odds)), shift=beyond, alike=prediction.alike)


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
        kinds=np.zeros(_BLENDS, np.intp),
    )
