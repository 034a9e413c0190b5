# SPDX-License-Identifier: Apache-2.0
"""For whoever chooses among many things, and then reports on the same data: is the choice chance, and how good is it?

The unit is the family of tests, as mutants of a road mostly end as it does. docs/claims.md has the rules, which were
fixed before they were applied to any campaign.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.stats import beta, t

from ds_analysis.common.statistics import Array, Bools, Indices, Interval, splits_of
from ds_base.intervals import LEVEL

PERMUTATIONS = 199
"""Permutations of a test of a split; chosen: p is a multiple of 0.005."""
SIGNS = 1999
"""Random signs of a test of a lead; chosen: Holm's adjustment of p for ten simulators still has room."""
ALPHA = 1.0 - LEVEL
"""p up to which a choice is stated."""
MOST_PARTS = 100
"""Parts of the families, each of which is divided by a split that the others choose; chosen: takes 0.1 s."""
SEED = 55
"""Seed of permutations, signs and parts; any number does."""
_ROUNDING = 1e-9
Label = TypeVar("Label", bound=str)
Axis = tuple[str, Sequence[float] | Array, int]
"""Name, (tests,) values, and 1 where larger values are harder, -1 where smaller ones are."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """Failures of a group of at least one test, and the 95% interval of their probability."""

    failures: int
    tests: int
    interval: Interval

    @classmethod
    def of(cls, failed: Bools, families: Indices) -> Share:
        """Count (tests,) outcomes of (tests,) families.

        The interval is Korn and Graubard's for tests in clusters (Survey Methodology 24, 1998).
        """
        tests, failures = len(failed), int(failed.sum())
        members = np.unique(families, return_inverse=True)[1]
        size, rate = float(members.max() + 1), failures / tests
        if 0 < failures < tests and size < tests:
            spread = np.bincount(members, failed - rate)
            variance = size / (size - 1.0) * float(spread @ spread) / tests**2 if size > 1 else 0.0
            worth = rate * (1.0 - rate) / variance if variance > 0.0 else float(tests)
            # The variance is itself an estimate, from few families.
            normal, student = t.ppf((1.0 + LEVEL) / 2.0, (np.inf, max(size - 1.0, 1.0)))
            size = min(worth, float(tests)) * (normal / student) ** 2
        return cls(failures=failures, tests=tests, interval=_clopper_pearson(rate * size, size))


def _clopper_pearson(failures: float, tests: float) -> Interval:
    """95% interval of a probability (Biometrika 26, 1934), also of effective numbers that are not whole."""
    tail, passes = ALPHA / 2.0, tests - failures
    low = float(beta.ppf(tail, failures, passes + 1.0)) if failures > _ROUNDING else 0.0
    high = float(beta.ppf(1.0 - tail, failures + 1.0, passes)) if passes > _ROUNDING else 1.0
    return low, high


@dataclass(frozen=True, kw_only=True, eq=False)
class ChosenSplit:
    """The split of tests with the largest Youden index over all axes and thresholds."""

    axis: str  # its name
    threshold: float  # value of the harder tests that is nearest to the others
    is_lower_bound: bool  # whether the harder tests have the threshold or more, otherwise the threshold or less
    harder: Bools  # (tests,)
    # Share of permutations of the families' outcomes among their mean places, the observed one among them, whose
    # largest Youden index is as large.
    p: float
    # Failures of the tests that the split of all other families calls harder, and gentler; None where there are none.
    apart: tuple[Share, Share] | None

    @property
    def is_clear(self) -> bool:
        """Whether it may be stated."""
        return self.p <= ALPHA and self.apart is not None


def choose_split(
    axes: Sequence[Axis], failed: Bools, families: Indices, rng: np.random.Generator
) -> ChosenSplit | None:
    """Choose a split of tests, and say how far it can be trusted; None if all end alike, or no axis has two values.

    Among equal splits the first axis counts, and on it the hardest threshold. `families` are numbers from 0; `rng`
    draws the permutations.
    """
    if not axes or failed.all() or not failed.any():
        return None
    values = np.array([sign * np.asarray(of) for _, of, sign in axes])
    gains, ranked = _gains(failed), _Ranked(values)
    if not ranked.ends.any():
        return None
    axis, threshold, _ = ranked.best(gains)
    name, _, sign = axes[axis]
    size = np.bincount(families)
    places = _Ranked(np.stack([np.bincount(families, of) / size for of in values]))
    of_family = np.asarray(np.bincount(families, gains), np.float64)
    best_scores = [
        places.best(of_family)[2],
        *(places.best(rng.permutation(of_family))[2] for _ in range(PERMUTATIONS)),
    ]
    called_harder = np.zeros(len(failed), np.bool_)
    for chosen_by, divided in splits_of(families, MOST_PARTS, SEED):
        size_before = np.zeros(len(failed))
        size_before[chosen_by] = _gains(failed[chosen_by])
        if size_before.any():
            k, least, _ = ranked.best(size_before)
            called_harder[divided] = values[k, divided] >= least
        else:  # all others end alike, and say the same of these
            called_harder[divided] = failed[chosen_by].any()
    harder = np.asarray(values[axis] >= threshold)
    return ChosenSplit(
        axis=name,
        threshold=sign * threshold,
        is_lower_bound=sign > 0,
        harder=harder,
        p=float(np.mean(np.array(best_scores) >= best_scores[0])),
        apart=_apart(failed, families, called_harder, harder) if 0 < called_harder.sum() < len(failed) else None,
    )


def _apart(failed: Bools, families: Indices, called_harder: Bools, harder: Bools) -> tuple[Share, Share]:
    """Shares of tests that others divide, less well; intervals reach outwards as far as those of the split itself."""
    sides = ((called_harder, harder), (~called_harder, ~harder))
    (one, chosen), (other, left) = ([Share.of(failed[part], families[part]) for part in both] for both in sides)
    return (
        replace(one, interval=(one.interval[0], max(one.interval[1], chosen.interval[1]))),
        replace(other, interval=(min(other.interval[0], left.interval[0]), other.interval[1])),
    )


def _gains(failed: Bools) -> Array:
    """What each test adds to the Youden index of the tests called harder: whole numbers, so that ties are exact."""
    failures = int(failed.sum())
    return np.where(failed, float(len(failed) - failures), -float(failures))


class _Ranked:
    """(axes, places) values on several axes, the hardest first, and where in that order a threshold may lie."""

    def __init__(self, values: Array) -> None:
        self.order = np.argsort(-values, axis=1, kind="stable")
        self.values = np.take_along_axis(values, self.order, axis=1)
        self.ends = np.diff(self.values, axis=1, append=self.values[:, -1:]) != 0.0

    def best(self, gains: Array) -> tuple[int, float, float]:
        """Axis and threshold of the harder places with the largest sum of (places,) gains, and that sum."""
        sums = np.where(self.ends, gains[self.order].cumsum(axis=1), -np.inf)
        axis, last = divmod(int(np.argmax(sums)), sums.shape[1])
        return axis, float(self.values[axis, last]), float(sums[axis, last])


def p_of_leads(leads: Array, families: Indices) -> Array:
    """Compute p of each candidate's lead; two-sided if a lead and its negative are candidates.

    It is the share of random signs of the families' leads of which the largest one is as large (Westfall, Young 1993).

    `leads`, (candidates, tests), say by how much each candidate leads; `families`, (tests,), are numbers from 0.

    Examples:
        >>> import numpy as np
        >>> lead = np.ones(8)
        >>> p_of_leads(np.stack((lead, -lead)), np.arange(8)) < 0.05
        array([ True, False])
    """
    of_family = np.array([np.bincount(families, lead) for lead in leads], np.float64)
    signs = np.random.default_rng(SEED).choice((-1.0, 1.0), (SIGNS, of_family.shape[1]))
    largest = np.append((signs @ of_family.T).max(axis=1), np.inf)  # the observed signs are one of the draws
    return np.asarray((largest >= leads.sum(axis=1)[:, None] - _ROUNDING).mean(axis=1))


def p_of_difference(changes: Array, families: Indices) -> float:
    """Two-sided p of no difference, from (tests,) 1, 0 or -1: in which direction a test differs, if it does."""
    return float(p_of_leads(np.stack((changes, -changes)), families).min())


def most_frequent(labels: Sequence[Label], families: Indices) -> Label | None:
    """The only label, or the most frequent one if it clearly leads the second, by `p_of_leads`; else None.

    That is, two-sided, a valid test against all labels (Gutmann and Maymin, Annals of Statistics 15, 1987).
    """
    ranked = [label for label, _ in Counter(labels).most_common(2)]
    if len(ranked) < 2:
        return ranked[0] if ranked else None
    first, second = (np.array([label == one for label in labels], np.float64) for one in ranked)
    return ranked[0] if p_of_difference(first - second, families) <= ALPHA else None
