# SPDX-License-Identifier: Apache-2.0
"""Predicts which tests a car fails: a mixture of experts, weighed by what the siblings and the car's drives say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from ds_analysis.common.outcome_table import OutcomeTable, OutcomeTableError
from ds_analysis.common.statistics import Array, Indices
from ds_analysis.prediction.experts import Expert, Learnt, SiblingOutcomes, experts_of

FEWEST_TESTS = 10
"""Tests with a verdict on some sibling that a prediction needs; chosen: fewer do not standardise a feature."""
WITHOUT_SIBLINGS = 0.25
"""Prior weight of the experts that do not use the siblings, before any outcome is seen; chosen: one car in four."""
EXCHANGEABLE = 0.8
"""Share of the prior that predicting each sibling from the others sets; siblings that agree may all miss; chosen."""
SAMPLE, SAMPLES = 60, 5
"""Tests of a sibling that weigh the experts, and samples of them; chosen: more tests leave one expert alone."""
DRAWS = 2000
"""Draws behind intervals; chosen: the ends of a 90% interval are accurate to about 0.01."""
_SAMPLE_SEED, _DRAW_SEED = 3, 17
_NEGLIGIBLE = 1e-9
"""Weight of an expert that is left out of sums; all of them together change no shown digit."""


class Drive(NamedTuple):
    """Verdict of one test on the car.

    Attributes:
        row: row of the test in its table.
        drawn: whether the test was drawn at random from all that were left; otherwise somebody chose it.
    """

    row: int
    failed: bool
    drawn: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """Prediction of every test of a table on a car, by experts with (experts,) weights before its ordered drives."""

    tests: int
    experts: tuple[Expert, ...]
    prior: Array
    drives: tuple[Drive, ...] = ()

    def updated(self, drives: Sequence[Drive]) -> Prediction:
        """Add drives of the car; what the siblings say stays as it is."""
        return replace(self, drives=(*self.drives, *drives))

    def only(self, *, siblings: bool) -> Prediction:
        """Keep the experts that use the siblings' outcomes, or those that do not."""
        kept = [k for k, expert in enumerate(self.experts) if expert.uses_siblings is siblings]
        return replace(self, experts=tuple(self.experts[k] for k in kept), prior=self.prior[kept])

    @cached_property
    def _learnt(self) -> list[Learnt]:
        rows = np.array([one.row for one in self.drives], np.intp)
        failed = np.array([one.failed for one in self.drives], np.float64)
        return [expert.after(rows, failed) for expert in self.experts]

    @cached_property
    def weights(self) -> Array:
        """(experts,) weights after the drives; they sum to 1."""
        return np.asarray(softmax(np.log(self.prior) + [one.log_evidence for one in self._learnt]))

    @property
    def shares(self) -> Mapping[str, float]:
        """Expert -> weight after the drives; experts that differ in a spread alone together."""
        weights: dict[str, float] = {}
        for expert, weight in zip(self.experts, self.weights, strict=True):
            weights[expert.name] = weights.get(expert.name, 0.0) + float(weight)
        return weights

    def probabilities(self, rows: Indices | None = None) -> Array:
        """(rows,) probability of failure of some tests, all if None; of a driven test its outcome."""
        rows = np.arange(self.tests) if rows is None else rows
        parts = zip(self.weights, self._learnt, strict=True)
        probabilities = np.sum([w * one.probabilities(rows) for w, one in parts if w > _NEGLIGIBLE], axis=0)
        return self._with_outcomes(np.clip(probabilities, 0.0, 1.0), rows)

    def draws(self, rows: Indices, *, count: int = DRAWS, outcomes: bool = True) -> Array:
        """(count, rows) probabilities of failure, each row for one draw of the car; the same on every call.

        Given the draw, tests are independent. With `outcomes`, driven tests have 0 or 1, as they turned out.
        """
        rng = np.random.default_rng(_DRAW_SEED)
        # Systematic draws of the experts: each comes as often as its weight says, but for rounding.
        places = np.searchsorted(np.cumsum(self.weights), (np.arange(count) + rng.random()) / count)
        times = np.bincount(np.minimum(places, len(self.experts) - 1), minlength=len(self.experts))
        parts = [one.draws(rng, int(k), rows) for k, one in zip(times, self._learnt, strict=True) if k]
        likelihoods = np.vstack(parts)
        return self._with_outcomes(likelihoods, rows) if outcomes else likelihoods

    def failures(self, rows: Indices) -> tuple[float, int, int]:
        """Expected number of tests that fail, and its 90% interval; the same on every call."""
        probabilities = self.draws(rows)
        rng = np.random.default_rng(_DRAW_SEED)
        counts = np.sort((rng.random(probabilities.shape) < probabilities).sum(axis=1))
        low, high = (int(counts[int(share * (len(counts) - 1))]) for share in (0.05, 0.95))
        return float(self.probabilities(rows).sum()), low, high

    def _with_outcomes(self, probabilities: Array, rows: Indices) -> Array:
        outcomes = np.full(self.tests, np.nan)
        outcomes[[drive.row for drive in self.drives]] = [drive.failed for drive in self.drives]
        driven = ~np.isnan(outcomes[rows])
        probabilities[..., driven] = outcomes[rows][driven]
        return probabilities


def too_few(table: OutcomeTable) -> str:
    """Why a table has too few tests for a prediction; empty if it has enough."""
    tests = int(table.on_a_sibling.sum())
    if tests >= FEWEST_TESTS:
        return ""
    return f"{tests} tests have a verdict on a sibling, expected at least {FEWEST_TESTS}: drive more tests"


def predict(table: OutcomeTable) -> Prediction:
    """Predict a car that was never driven from a table's siblings; a twin's outcomes are not looked at.

    Raises:
        OutcomeTableError: too few tests, or a sibling without a verdict.
    """
    driven, failed = table.sibling_verdicts
    if reason := too_few(table):
        raise OutcomeTableError(reason)
    for name, known in zip(table.siblings, driven.T, strict=True):
        if not known.any():
            raise OutcomeTableError(f"no test has a verdict on {name}: drive tests there, or leave it out")
    features = table.features[table.on_a_sibling]
    scale = features.std(axis=0)
    used = scale > 1e-12
    count = len(table.siblings)
    lateral, limits = table.lateral[:, :count], table.limits[:, :count]
    outcomes = SiblingOutcomes(
        features=(table.features[:, used] - features[:, used].mean(axis=0)) / scale[used],
        failed=failed,
        known=driven,
        margins=np.log(np.maximum(lateral, 1e-3 * limits) / limits),
    )
    return Prediction(tests=len(table), experts=tuple(experts_of(outcomes)), prior=_prior_of(outcomes))


def _prior_of(outcomes: SiblingOutcomes) -> Array:
    """(experts,) weights: as good as each expert predicts a few tests of a sibling from the others, and a rest."""
    using = np.array([expert.uses_siblings for expert in experts_of(outcomes)])
    flat = np.where(using, (1.0 - WITHOUT_SIBLINGS) / using.sum(), WITHOUT_SIBLINGS / (~using).sum())
    count = outcomes.failed.shape[1]
    total = flat.copy()
    rng = np.random.default_rng(_SAMPLE_SEED)
    for one in range(count if count > 1 else 0):
        experts = experts_of(outcomes.of([k for k in range(count) if k != one]))
        judged = np.flatnonzero(outcomes.known[:, one])
        for _ in range(SAMPLES):
            rows = rng.choice(judged, min(SAMPLE, len(judged)), replace=False)
            evidence = [expert.after(rows, outcomes.failed[rows, one].astype(np.float64)) for expert in experts]
            total += softmax(np.log(flat) + [learnt.log_evidence for learnt in evidence]) / SAMPLES
    return np.asarray(EXCHANGEABLE * total / total.sum() + (1.0 - EXCHANGEABLE) * flat)
