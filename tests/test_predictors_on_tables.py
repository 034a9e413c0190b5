# SPDX-License-Identifier: Apache-2.0
"""Predictions of a car on the shipped tables of outcomes, beside simpler rules."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from benchmarks.predictors import KINDS, OURS, answers, behind, cars_of, made, score

from ds_analysis.prediction.mixture import predict


@pytest.fixture(scope="module")
def ours() -> list[Path]:
    return sorted(one.parent for one in OURS.glob("*/outcomes.parquet"))


def test_no_simple_rule_is_much_better_on_any_table(ours: list[Path]) -> None:
    """Never more than 0.02 behind the best of five after 4 and 8 drives, 0.01 in the mean, 0.035 without a drive."""
    scored = {folder.name: [score(hidden, failed) for _, hidden, failed in cars_of(folder)] for folder in ours}
    distances = {name: behind(cars) for name, cars in scored.items()}
    assert len(distances) >= 6
    for budget, most in ((0, 0.035), (4, 0.02), (8, 0.02)):
        assert max(of[budget] for of in distances.values()) <= most, distances
        assert np.mean([of[budget] for of in distances.values()]) <= 0.01
    calls = np.sum([car.calls[8] for cars in scored.values() for car in cars], axis=0)
    safe, failed, fails, completed, intervals, hold = calls
    assert safe > 1000 and failed / safe <= 0.05 and fails > 100 and completed / fails <= 0.05
    assert hold / intervals >= 0.85


def test_it_says_whether_siblings_have_helped(ours: list[Path]) -> None:
    """Siblings predict a car as it is, and not one that does not follow them; a false praise is rare."""
    said: Counter[tuple[str, str]] = Counter()
    for folder in ours[:5]:
        for _, hidden, failed in cars_of(folder):
            prediction = predict(hidden)
            for k, kind in enumerate(KINDS):
                outcomes = made(hidden, failed, kind, np.random.default_rng([3, k]))
                for budget, answer in answers(prediction, outcomes, [8, k]):
                    said[kind, answer] += budget == 50
    cars = sum(said["control", answer] for answer in ("helped", "misled", "open"))
    assert cars == 15 and said["control", "helped"] <= 2 and said["opposite", "helped"] <= 1
    assert said["as it is", "helped"] >= 8 and said["as it is", "misled"] == 0
    assert said["other", "misled"] >= 10 and said["other", "helped"] == 0
