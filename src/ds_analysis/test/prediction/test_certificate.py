# SPDX-License-Identifier: Apache-2.0
"""Bounds hold with 95% under stopping rules that try to break them, and predictions make them narrower."""

from __future__ import annotations

import numpy as np
import pytest

from ds_analysis.common.statistics import Array, Bools, Indices
from ds_analysis.prediction.betting import Bet, certify, drives_until


def bets_of(truth: Bools, predicted: Array, order: Indices, drawn: Bools) -> list[Bet]:
    left = np.ones(len(truth), bool)
    found = []
    for row, by_chance in zip(order, drawn, strict=True):
        found.append(
            Bet(
                failed=bool(truth[row]),
                drawn=bool(by_chance),
                predicted=float(predicted[row]),
                mean_predicted=float(predicted[left].mean()),
            )
        )
        left[row] = False
    return found


def mixed_order(truth: Bools, predicted: Array, rng: np.random.Generator) -> tuple[Indices, Bools]:
    """Every other test is chosen: here adversarially, the likeliest to fail; the others are drawn."""
    left, order = set(range(len(truth))), []
    for place in range(len(truth)):
        rows = np.array(sorted(left))
        row = int(rng.choice(rows)) if place % 2 else int(rows[np.argmax(predicted[rows] + truth[rows])])
        order.append(row)
        left.remove(row)
    return np.array(order, np.intp), np.arange(len(truth)) % 2 == 1


@pytest.mark.parametrize("rate", [0.0, 0.05, 0.3, 0.5, 0.9])
@pytest.mark.parametrize("chosen", [False, True])
def test_the_truth_is_hardly_ever_excluded_at_any_time(rate: float, chosen: bool) -> None:
    """Stopped at the worst moment of all: whenever the truth is outside for the first time, or never."""
    wrong, runs, tests = 0, 150, 60
    for seed in range(runs):
        rng = np.random.default_rng([seed, int(100 * rate)])
        truth = rng.random(tests) < rate
        predicted = np.clip(truth + rng.normal(0.0, 0.4, tests), 0.01, 0.99)  # any predictions are allowed
        order, drawn = mixed_order(truth, predicted, rng) if chosen else (rng.permutation(tests), np.ones(tests, bool))
        bets = bets_of(truth, predicted, order, drawn)
        ends = [certify(bets[:k], tests) for k in range(1, tests + 1, 3)]
        wrong += any(not one.low <= truth.sum() <= one.high for one in ends)
    assert wrong / runs <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / runs)


def test_good_predictions_narrow_the_bounds_and_bad_ones_cost_little() -> None:
    widths: dict[str, list[int]] = {"good": [], "none": [], "bad": []}
    for seed in range(30):
        rng = np.random.default_rng(seed)
        truth = rng.random(200) < 0.4
        order = rng.permutation(200)[:60]
        for name, predicted in (
            ("good", np.where(truth, 0.97, 0.03)),
            ("none", np.full(200, 0.4)),
            ("bad", rng.permutation(truth) * 1.0),
        ):
            found = certify(bets_of(truth, predicted, order, np.ones(60, bool)), 200)
            widths[name].append(found.high - found.low)
    good, none, bad = (float(np.mean(widths[name])) for name in ("good", "none", "bad"))
    assert good < none and bad < 1.25 * none


def test_drives_needed_are_those_after_which_the_bound_is_reached() -> None:
    needed = drives_until(0.1, 200)
    assert needed is not None and 24 < needed < 60  # Jeffreys, with a size fixed beforehand: 24
    without = [Bet(failed=False, drawn=True)]
    assert certify(without * needed, 200).high <= 20 < certify(without * (needed - 1), 200).high
    assert drives_until(0.0, 20) == 20
