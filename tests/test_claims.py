"""Claims of the product: hardly ever made under noise, mostly made under a clear effect; see docs/claims.md.

Fast versions of `benchmarks/claims.py`. An error rate may exceed 5 % by two standard errors of the number of campaigns.
"""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import claims
from benchmarks.claims import EFFECTS, NOISES

STATED = 5
"""Column of a row that holds the share of campaigns in which the claim is made."""


def at_most(campaigns: int) -> float:
    return 0.05 + 2.0 * float(np.sqrt(0.05 * 0.95 / campaigns))


@pytest.mark.parametrize("size", [24, 40])
@pytest.mark.parametrize("noise", NOISES, ids=lambda one: one.name)
def test_a_split_is_hardly_ever_stated_under_noise(size: int, noise: claims.Effect) -> None:
    assert claims.splits(size, 3, noise, 150)[STATED] <= at_most(150)


def test_a_clear_effect_is_stated_with_intervals_that_cover() -> None:
    *_, stated, before, harder, other = claims.splits(40, 3, EFFECTS[0], 100)
    assert stated > 0.85 and min(harder, other) >= 0.95, (stated, before, harder, other)


def test_a_second_split_is_hardly_ever_stated_without_an_effect() -> None:
    assert claims.second_splits(40, 3, NOISES[0], 100)[STATED] <= at_most(100)


@pytest.mark.parametrize("siblings", [2, 4])
def test_a_sibling_is_believed_only_if_it_follows_the_twin(siblings: int) -> None:
    assert claims.beliefs(40, siblings, 0.0, 200)[STATED] <= at_most(200)
    assert claims.beliefs(40, siblings, 0.9, 50)[STATED] > 0.9


def test_a_way_of_failing_leads_only_if_it_does() -> None:
    assert claims.most_often(40, 0.25, 300)[STATED] <= at_most(300)
    assert claims.most_often(40, 0.7, 100)[STATED] > 0.5


def test_networks_that_are_alike_are_hardly_ever_called_worse_or_better() -> None:
    for row in claims.verdicts(40, 0.0, 15):
        assert row[STATED] <= at_most(15)


def test_a_condition_comes_first_only_if_enough_roads_agree() -> None:
    assert claims.first_conditions(3, 4, 20)[STATED] == 0.0
    assert claims.first_conditions(12, 0, 200)[STATED] <= at_most(200)
    assert claims.first_conditions(12, 4, 50)[STATED] > 0.6
