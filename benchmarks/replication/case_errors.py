# SPDX-License-Identifier: Apache-2.0
"""How often `ds evaluate` states a wrong merge case, and how often the right one, on simulated campaigns.

`python -m benchmarks.replication.case_errors`. Two siblings and a twin drive the same tests. Tests of a family resemble
each other, in difficulty and in what a simulator makes of them; families are about as uneven as those of a search. The
designs were fixed before any rate was computed. Only the last two of equal rates were added to break a first version,
which had no opposite family, and did.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.stats import norm

from ds_analysis.common.statistics import Bools, Indices
from ds_analysis.paper.merge_case import Advice, merge_case

NAMES = ("one sibling", "the other", "twin")
SHARED, OF_FAMILY = 0.3, 0.4
"""Share of the variance of a test's difficulty that all simulators share, and that a simulator's family shares."""


@dataclass(frozen=True)
class Design:
    """Simulated campaigns.

    Attributes:
        name: in words.
        rates: failure rates of both siblings and the twin.
        right: the case; None if a sibling fails as often as the twin, so that every case is wrong.
        lumped: the first sibling fails on whole families, the twin on single tests.
    """

    name: str
    rates: tuple[float, float, float]
    right: Advice | None = None
    lumped: bool = False


DESIGNS = (
    Design("all equal, 10%", (0.1, 0.1, 0.1)),
    Design("all equal, 30%", (0.3, 0.3, 0.3)),
    Design("all equal, one in lumps", (0.2, 0.2, 0.2), lumped=True),
    Design("one equal, one more often", (0.2, 0.6, 0.2)),
    Design("one in lumps less often, one equal", (0.05, 0.3, 0.3), lumped=True),
    Design("one equal in lumps, 10%, one more often", (0.1, 0.7, 0.1), lumped=True),
    Design("one equal in lumps, 3%, one more often", (0.03, 0.5, 0.03), lumped=True),
    Design("both more often", (0.4, 0.5, 0.2), "product"),
    Design("one more often, one less", (0.1, 0.5, 0.25), "mean"),
    Design("both less often", (0.1, 0.2, 0.4), "hardest sibling"),
)
SIZES = ((14, 1), (40, 1), (120, 8), (340, 8), (1700, 8))
"""Tests, and tests of a family."""


def simulated(design: Design, tests: int, size: int, rng: np.random.Generator) -> tuple[dict[str, Bools], Indices]:
    """Outcomes of one campaign, and the families of its tests."""
    many = tests // size
    families = np.arange(tests) if size == 1 else (many * rng.random(tests) ** 2).astype(np.intp)
    shared = rng.standard_normal(many)[families]
    failed = {}
    for k, (name, rate) in enumerate(zip(NAMES, design.rates, strict=True)):
        own = rng.standard_normal(many)[families]
        of_family, rest = OF_FAMILY**0.5 * own, (1 - SHARED - OF_FAMILY) ** 0.5 * rng.standard_normal(tests)
        value = SHARED**0.5 * shared + of_family + rest
        if design.lumped and k != 1:
            value = own if k == 0 else rng.standard_normal(tests)
        failed[name] = value < norm.ppf(rate)
    return failed, families


def rates_of(design: Design, tests: int, size: int, campaigns: int, seed: int) -> tuple[float, float]:
    """Share of campaigns with a wrong case, and with the right one."""
    rng = np.random.default_rng([seed, tests, size])
    advice = []
    for _ in range(campaigns):
        failed, families = simulated(design, tests, size, rng)
        advice.append(merge_case(failed, NAMES[-1], families).advice)
    right = sum(one == design.right for one in advice)
    return sum(one != "drive" for one in advice) / campaigns - right / campaigns, right / campaigns


def main() -> None:
    """Print the table, as for a page."""
    print("| | tests | in a family | a wrong case | the right case |\n|---|---|---|---|---|")
    campaigns = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    for design, (tests, size) in product(DESIGNS, SIZES):
        wrong, right = rates_of(design, tests, size, campaigns, seed=0)
        print(f"| {design.name} | {tests} | {size} | {100 * wrong:.1f}% | {100 * right:.1f}% |")


if __name__ == "__main__":
    main()
