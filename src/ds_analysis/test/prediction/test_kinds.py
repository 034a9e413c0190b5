"""A car that the siblings do not predict is noticed, costs little, and one that they predict loses little."""

from __future__ import annotations

import numpy as np
import pytest
from prediction_tables import alike, made_up, table_of_margins

from ds_analysis.common.statistics import Array, Indices
from ds_analysis.prediction.population import KINDS
from ds_analysis.prediction.twin_prediction import (
    DOUBT,
    MarginDrive,
    TwinPrediction,
    outcomes_of,
    predict_twin,
    span_of,
)


def drives_of(truth: Array, rows: Indices) -> list[MarginDrive]:
    return [
        MarginDrive(row=int(k), failed=bool(truth[k] > 0), margin=None if truth[k] > 0 else float(truth[k]))
        for k in rows
    ]


def brier(prediction: TwinPrediction, truth: Array) -> float:
    return float(np.mean((prediction.probabilities() - (truth > 0)) ** 2))


def test_after_some_drives_a_car_that_is_unlike_is_noticed_and_its_rate_is_all_that_counts() -> None:
    unlike, like, excess, loss = [], [], [], []
    for seed in range(10):
        table, made = made_up(600 + seed, tests=120)
        before, rng = predict_twin(table), np.random.default_rng(seed)
        rows = rng.permutation(120)[:16]
        own = made.margins[:, 3]
        found = before.updated(drives_of(own, rows))
        like.append(found.alike)
        loss.append(brier(found, own) - brier(alike(before).updated(drives_of(own, rows)), own))
        other = own[rng.permutation(120)]
        found = before.updated(drives_of(other, rows))
        unlike.append(found.alike)
        rate = (float((other[rows] > 0).sum()) + 0.5) / 17.0
        least = float(np.mean(np.where(np.isin(np.arange(120), rows), 0.0, (rate - (other > 0)) ** 2)))
        excess.append(brier(found, other) - least)
        assert ("do not predict this car" in span_of(found).warning) == (found.alike < DOUBT)
    assert np.median(unlike) < 0.2 and np.median(like) > 0.5
    assert np.mean(excess) < 0.02 and np.mean(loss) < 0.01


def test_each_sibling_tells_of_its_kind_when_the_others_predict_it() -> None:
    table, made = made_up(610, tests=120, siblings=4)
    found = predict_twin(table)
    assert set(found.in_turn) == set(table.siblings)
    assert all(KINDS[int(np.argmax(shares))] == "alike" for shares in found.in_turn.values())
    margins = made.margins.copy()
    margins[:, 0] = margins[np.random.default_rng(1).permutation(120), 0]
    moved = predict_twin(table_of_margins(margins[:, :5], table.features))
    assert moved.in_turn[table.siblings[0]][0] < 0.1 and moved.alike < found.alike
    assert "unlike" in moved.kinds_sentence and f"probability of {moved.alike:.2f}" in moved.kinds_sentence


def test_the_twins_outcomes_are_not_looked_at_and_all_of_a_simulators_are_found() -> None:
    table, made = made_up(620, tests=40)
    named = table.simulators[-1]
    found = outcomes_of(table, named)
    assert [one.row for one in found] == list(range(40))
    assert [one.failed for one in found] == (made.margins[:, 3] > 0).tolist()
    known = [one.margin for one in found if one.margin is not None]
    assert known == pytest.approx(made.margins[made.margins[:, 3] <= 0, 3], abs=1e-6)
