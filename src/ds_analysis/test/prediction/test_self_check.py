"""Calls checked on the siblings: they hold on a known population, and not where a sibling has failures of its own."""

from __future__ import annotations

import json

import numpy as np
import pytest
from prediction_tables import made_up, table_of_margins

from ds_analysis.common.outcome_table import State
from ds_analysis.prediction.calibration import check_in_turn
from ds_analysis.prediction.twin_prediction import predict_twin


@pytest.mark.long
def test_calls_hold_on_populations_that_are_what_the_model_takes_them_for() -> None:
    checks = [check_in_turn(made_up(seed, tests=120, mean=(-1.0, 0.6, 0.4, -0.4, 0.2))[0]) for seed in range(400, 406)]
    calls = [calls for check in checks for calls in (check.safe, check.failing)]
    assert sum(one.count for one in calls) > 100
    assert sum(one.wrong for one in calls) <= 0.05 * sum(one.count for one in calls)
    assert sum(bool(check.warning) for check in checks) <= 1
    for check in checks:
        assert check.safe.count == sum(one.safe[0] for one in check.siblings)
        assert check.safe.wrong == sum(one.safe[1] for one in check.siblings)
        json.dumps(check.document(), allow_nan=False)


def test_a_sibling_that_fails_in_a_way_of_its_own_is_noticed() -> None:
    """Three follow one feature closely; one also fails in a fifth of the families, whatever the feature."""
    rng = np.random.default_rng(1)
    features = rng.normal(size=(200, 2))
    margins = -1.2 + 0.6 * features[:, :1] + 0.1 * rng.normal(size=(200, 5))
    assert not check_in_turn(table_of_margins(margins, features)).warning
    margins[np.repeat(rng.random(40) < 0.2, 5), 2] = 0.5
    table = table_of_margins(margins, features)
    check = check_in_turn(table)
    assert check.safe.too_many and not check.failing.too_many
    assert "do not rely on safe:" in check.warning and " called safe " in check.sentence
    own = {one.simulator: one for one in check.siblings}
    assert own["c"].safe[1] > 10 and all(own[name].safe[1] <= 2 for name in ("a", "b", "d"))
    # What is counted is what the prediction of that sibling says.
    turned = table.with_twin(None).with_twin("c")
    safe = predict_twin(turned).probabilities() <= 0.05
    assert own["c"].safe == (safe.sum(), (safe & turned.failed("c")).sum())
    # The twin is not looked at.
    table.states[:, -1] = State.MISSING
    assert check_in_turn(table).document() == check.document()


@pytest.mark.parametrize(("tests", "siblings"), [(60, 2), (60, 1), (9, 3)])
def test_too_few_siblings_or_tests_are_said(tests: int, siblings: int) -> None:
    check = check_in_turn(made_up(1, tests=tests, siblings=siblings)[0])
    assert not check.siblings and not check.warning
    assert check.sentence == "Calls cannot be checked on the siblings: that takes 3 of them with 10 common tests"
