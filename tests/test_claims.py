# SPDX-License-Identifier: Apache-2.0
"""Claims of the product: hardly ever made under noise, mostly made under a clear effect; see docs/claims.md.

Fast versions of `benchmarks/claims.py`. An error rate may exceed 5% by two standard errors of the number of campaigns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from benchmarks import claims
from benchmarks.claims import EFFECTS, NOISES

from ds_base.table import Value


def stated(row: Sequence[Value]) -> float:
    """Share of campaigns in which the claim is made."""
    assert isinstance(row[5], float)
    return row[5]


def at_most(campaigns: int) -> float:
    return 0.05 + 2.0 * float(np.sqrt(0.05 * 0.95 / campaigns))


@pytest.mark.parametrize("size", [24, 40])
@pytest.mark.parametrize("noise", NOISES, ids=lambda one: one.name)
def test_a_split_is_hardly_ever_stated_under_noise(size: int, noise: claims.Effect) -> None:
    assert stated(claims.splits(size, 3, noise, 150)) <= at_most(150)


def test_a_clear_effect_is_stated_with_intervals_that_cover() -> None:
    row = claims.splits(40, 3, EFFECTS[0], 100)
    covered = [share for share in row[-2:] if isinstance(share, float)]
    assert stated(row) > 0.85 and len(covered) == 2 and min(covered) >= 0.95


def test_a_second_split_is_hardly_ever_stated_without_an_effect() -> None:
    assert stated(claims.second_splits(40, 3, NOISES[0], 100)) <= at_most(100)


@pytest.mark.parametrize("siblings", [2, 4])
def test_a_sibling_is_believed_only_if_it_follows_the_twin(siblings: int) -> None:
    assert stated(claims.beliefs(40, siblings, 0.0, 200)) <= at_most(200)
    assert stated(claims.beliefs(40, siblings, 0.9, 50)) > 0.9


def test_a_way_of_failing_leads_only_if_it_does() -> None:
    assert stated(claims.most_often(40, 0.25, 300)) <= at_most(300)
    assert stated(claims.most_often(40, 0.7, 100)) > 0.5


def test_networks_that_are_alike_are_hardly_ever_called_worse_or_better() -> None:
    for row in claims.verdicts(40, 0.0, 15):
        assert stated(row) <= at_most(15)


def test_a_network_that_fails_far_more_often_is_mostly_called_worse() -> None:
    """The table has 0.64; where simulators' names are not those of the drives, none is called so."""
    (row,) = claims.verdicts(40, 0.5, 10)
    assert stated(row) > 0.5
