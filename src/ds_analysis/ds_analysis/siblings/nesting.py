"""How far one simulator's failures lie inside another's."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from statsmodels.stats.proportion import proportion_confint

from ds_analysis.common.cross_validation import Array, Outcome
from ds_analysis.common.families import Indices, are_alone, interval_over_families
from ds_analysis.siblings.outcomes import Outcomes

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Nesting:
    """Failures of two simulators on the same roads.

    Attributes:
        first: name of the first simulator.
        second: name of the second simulator.
        both: number of roads on which both fail.
        only_first: number of roads on which only the first fails.
        only_second: number of roads on which only the second fails.
        neither: number of roads on which none fails.
        second_given_first: share of the first's failures on which the second fails too; None if the first never fails.
        second_given_first_interval: its 95 % interval: Clopper and Pearson's (Biometrika 26, 1934), or a bootstrap over
            families where roads descend from each other.
        first_given_second: the same the other way round.
        first_given_second_interval: its interval.
    """

    first: str
    second: str
    both: int
    only_first: int
    only_second: int
    neither: int
    second_given_first: float | None
    second_given_first_interval: Interval | None
    first_given_second: float | None
    first_given_second_interval: Interval | None


def nestings(outcomes: Outcomes) -> list[Nesting]:
    """Count on which roads each pair of simulators fails, in their order."""
    found = []
    for first, second in combinations(outcomes.simulators, 2):
        one, other = outcomes.failures(first), outcomes.failures(second)
        forward, forward_interval = _share(other[one], outcomes.families[one])
        backward, backward_interval = _share(one[other], outcomes.families[other])
        found.append(
            Nesting(
                first=first,
                second=second,
                both=int((one & other).sum()),
                only_first=int((one & ~other).sum()),
                only_second=int((~one & other).sum()),
                neither=int((~one & ~other).sum()),
                second_given_first=forward,
                second_given_first_interval=forward_interval,
                first_given_second=backward,
                first_given_second_interval=backward_interval,
            )
        )
    return found


def _share(failed: Outcome, families: Indices) -> tuple[float | None, Interval | None]:
    """Share of failures among roads, and its interval."""
    if not len(failed):
        return None, None
    share = float(failed.mean())
    if 0.0 < share < 1.0 and not are_alone(families):
        return share, interval_over_families((failed.astype(np.float64),), _mean, families)
    # Where all are alike, a bootstrap has no width, and a family counts as one observation.
    alone = len(np.unique(families))
    low, high = proportion_confint(round(share * alone), alone, alpha=0.05, method="beta")
    return share, (float(low), float(high))


def _mean(values: Array) -> float:
    return float(values.mean())
