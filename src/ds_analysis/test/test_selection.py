# SPDX-License-Identifier: Apache-2.0
"""A choice is stated only if chance hardly makes it, and measured on tests that did not choose it."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from statsmodels.stats.proportion import proportion_confint

from ds_analysis.common.selection import ALPHA, Share, choose_split, most_frequent, p_of_leads
from ds_analysis.common.statistics import Array, Bools, Indices

SIZES = ((4, 3, 2, 2, 2, 1), (6, 5, 5, 3, 3, 3, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1))
FAMILIES = {sum(sizes): np.repeat(np.arange(len(sizes)), sizes) for sizes in SIZES}
"""Tests -> their families, of sizes that searches of these lengths have."""
CAMPAIGNS = 300


def values_of(families: Indices, axes: int, rng: np.random.Generator) -> Array:
    """Mutants are near their root: nine tenths of the variance lie between families, as in searches."""
    roots = rng.standard_normal((axes, families.max() + 1))
    return roots[:, families] + rng.standard_normal((axes, len(families))) / 3.0


def drawn(rate: Array, rng: np.random.Generator) -> Bools:
    return rng.random(len(rate)) < rate


@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize(("tests", "axes"), [(14, 3), (14, 12), (40, 3), (40, 12)])
def test_noise_is_stated_in_at_most_a_twentieth_of_campaigns(tests: int, axes: int, alike: bool) -> None:
    """Also where mutants of a road end alike, for reasons that no axis knows."""
    rng = np.random.default_rng([tests, axes, alike])
    families, stated = FAMILIES[tests], 0
    for _ in range(CAMPAIGNS):
        rate = rng.choice((0.05, 0.95), families.max() + 1)[families] if alike else np.full(tests, 0.3)
        split = choose_split(values_of(families, axes, rng), drawn(rate, rng), families, rng)
        stated += split is not None and split.is_clear
    assert stated / CAMPAIGNS <= ALPHA + 2.0 * np.sqrt(ALPHA * (1.0 - ALPHA) / CAMPAIGNS)


def test_a_clear_effect_is_found_and_its_shares_are_covered() -> None:
    rng = np.random.default_rng(1)
    families, stated, covered = FAMILIES[40], 0, np.zeros(2)
    for _ in range(CAMPAIGNS):
        values = values_of(families, 3, rng)
        # An axis of unit variance, and a tenth of it within families; the threshold is in the middle.
        rate = np.where(values[1] > 0.25, 0.9, 0.05)
        split = choose_split(values, drawn(rate, rng), families, rng)
        if split is None or not split.is_clear or split.apart is None:
            continue
        stated += 1
        others = np.sqrt(1.0 + 1.0 / 9.0) * rng.standard_normal(2000)
        truth = np.where(others > 0.25, 0.9, 0.05) if split.axis == 1 else np.full(2000, 0.4)
        for side, share in enumerate(split.apart):
            low, high = share.interval
            covered[side] += low <= truth[(others >= split.threshold) == (side == 0)].mean() <= high
    assert stated / CAMPAIGNS > 0.8
    assert (covered / stated >= 0.95).all()


def test_p_is_the_share_of_all_orders_of_the_families() -> None:
    """Against every permutation of six families of one size, by hand."""
    rng = np.random.default_rng(2)
    families, failed = np.repeat(np.arange(6), 2), np.array([0, 1, 0, 0, 1, 1, 0, 0, 1, 0, 1, 1], np.bool_)
    place = np.array([3.0, 1.0, 5.0, 0.0, 2.0, 4.0])
    failures = np.bincount(families, failed)

    def largest(order: tuple[int, ...]) -> float:
        by_place = failures[list(order)][np.argsort(-place)]
        return max(by_place[:k].sum() / 6 - (2 * k - by_place[:k].sum()) / 6 for k in range(1, 6))

    every = [largest(order) for order in permutations(range(6))]
    split = choose_split(place[families][None], failed, families, rng)
    assert split is not None
    assert split.p == pytest.approx(np.mean(np.array(every) >= every[0] - 1e-9), abs=0.08)
    assert every[0] == largest((0, 1, 2, 3, 4, 5))


def test_tests_that_end_alike_have_no_split() -> None:
    rng = np.random.default_rng(1)
    for failed in (np.ones(9, np.bool_), np.zeros(9, np.bool_)):
        assert choose_split(np.arange(9.0)[None], failed, np.arange(9), rng) is None
    assert choose_split(np.ones((2, 9)), np.arange(9) > 3, np.arange(9), rng) is None


def test_families_make_intervals_wider() -> None:
    failed = np.arange(24) % 4 == 0
    alone = Share.of(failed, np.arange(24)).interval
    assert alone == pytest.approx(proportion_confint(6, 24, method="beta"))
    together = Share.of(np.repeat([True, False, False, False] * 2, 3), np.repeat(np.arange(8), 3)).interval
    assert together[1] - together[0] > 1.3 * (alone[1] - alone[0])
    # Where all end alike, a family counts as one test.
    alike = Share.of(np.ones(24, np.bool_), np.arange(24) // 3).interval
    assert alike == pytest.approx(proportion_confint(8, 8, method="beta"))


def test_the_best_of_three_is_named_only_if_its_lead_is_no_accident() -> None:
    rng = np.random.default_rng(4)
    named = 0
    for _ in range(CAMPAIGNS):
        agrees = rng.random((3, 12)) < 0.5
        named += bool((p_of_leads(np.where(agrees, 1.0, -1.0), np.arange(12)) <= ALPHA).any())
    assert named / CAMPAIGNS <= 0.05 + 2.0 * np.sqrt(0.05 * 0.95 / CAMPAIGNS)
    assert p_of_leads(np.ones((1, 12)), np.arange(12))[0] == pytest.approx(1 / 2000, abs=1e-3)


def test_a_label_leads_only_if_the_second_is_clearly_rarer() -> None:
    alone = np.arange(24)
    assert most_frequent(["wide"] * 18 + ["cuts"] * 6, alone) == "wide"
    assert most_frequent(["wide"] * 13 + ["cuts"] * 11, alone) is None
    # The eighteen descend from three roads, the six from one.
    assert most_frequent(["wide"] * 18 + ["cuts"] * 6, alone // 6) is None
    assert most_frequent(["wide"] * 3, np.arange(3)) == "wide" and most_frequent([], np.arange(0)) is None


def test_shares_are_measured_by_the_splits_of_other_families() -> None:
    families = np.arange(20)
    values, failed = np.arange(20.0)[None], np.arange(20) >= 12
    split = choose_split(values, failed, families, np.random.default_rng(1))
    assert split is not None and split.is_clear and split.apart is not None
    assert split.threshold == 12.0 and split.harder.tolist() == failed.tolist()
    # Without test 12, whose value decides, the others call harder what is 13 or more.
    assert [(one.failures, one.tests) for one in split.apart] == [(7, 7), (1, 13)]
