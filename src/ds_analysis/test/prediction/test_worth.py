"""What real drives are worth in simulated ones and in random ones, and when to stop."""

from __future__ import annotations

import json

import numpy as np
import pytest
from prediction_tables import made_up
from test_real_drives import drive_of

from ds_analysis.prediction.real.drive_choice import (
    LEAST_GAIN,
    _simulated,
    choose,
    expected_error,
    random_drives,
    worth_of,
)
from ds_analysis.prediction.twin_prediction import predict_twin


@pytest.mark.parametrize(("rate", "drives"), [(0.1, 20), (0.5, 8), (0.3, 100)])
def test_random_drives_are_those_whose_posterior_is_as_wide(rate: float, drives: int) -> None:
    """By drawing from Jeffreys' posterior."""
    posterior = np.random.default_rng(1).beta(rate * drives + 0.5, (1 - rate) * drives + 0.5, 400_000)
    low, high = np.quantile(posterior, (0.05, 0.95))
    assert random_drives(float(high - low), rate) == pytest.approx(drives, rel=0.02)
    assert random_drives(1.0, rate) == 0.0


def test_tests_on_the_siblings_narrow_the_coefficients_down_to_the_limit() -> None:
    """What the limit leaves out falls about as one over the number of tests, and is never negative."""

    def rest(tests: int) -> float:
        population = predict_twin(made_up(5, tests=tests)[0], in_turn=False).population
        beyond = population.twin.covariances - population.limit.covariances
        assert np.linalg.eigvalsh(beyond).min() > -1e-9
        return float(population.twin.weights @ np.trace(beyond, axis1=1, axis2=2))

    few, some, many = rest(25), rest(250), rest(2500)
    assert 4.0 < few / some < 25.0 and 4.0 < some / many < 25.0


def test_worth_in_simulated_drives_inverts_the_width() -> None:
    """Squared widths 0.04 + 0.05 * 60 / n: 120 tests, so 60 more on three siblings, are as good as two real drives."""
    before, after = np.sqrt(0.04 + 0.05), np.sqrt(0.04 + 0.05 * 60 / 120)
    assert _simulated(before, 0.2, after, tests=60, siblings=3, drives=2) == pytest.approx(60 * 3 / 2)
    assert _simulated(0.3, 0.2, 0.19, tests=60, siblings=3, drives=2) == float("inf")
    assert _simulated(0.3, 0.2, 0.31, tests=60, siblings=3, drives=2) is None


def test_one_drives_until_the_next_one_tells_little() -> None:
    table, truth = made_up(11, tests=120)
    before = after = predict_twin(table)
    first = choose(table, before, 1)[0].gain
    assert first is not None
    gains = [first / expected_error(table, before)]
    for _ in range(24):
        (choice,) = choose(table, after, 1, drawn=False)
        after = after.updated([drive_of(truth.margins[:, 3], choice.row)])
        found = worth_of(table, before, after)
        assert found.next_gain is not None and found.stop == (found.next_gain < LEAST_GAIN)
        gains.append(found.next_gain)
        if found.stop:
            break
    assert found.stop and gains[0] > LEAST_GAIN and found.drives < 24
    assert found.width_after < found.width_before and found.sentences[-1].startswith("stop")
    actual = (after.probabilities() - (truth.margins[:, 3] > 0)) ** 2
    assert expected_error(table, after) == pytest.approx(actual.mean(), abs=0.06)
    everything = before.updated([drive_of(truth.margins[:, 3], row) for row in range(120)])
    last = worth_of(table, before, everything)
    assert last.stop and last.next_gain is None and "every test was driven" in last.sentences[-1]
    json.dumps(last.document(), allow_nan=False)


def test_the_anchor_is_the_variance_that_calibrated_predictions_explain() -> None:
    table, truth = made_up(12, tests=150)
    before = predict_twin(table)
    after = before.updated([drive_of(truth.margins[:, 3], 0)])
    probabilities = before.probabilities()
    outcomes = np.random.default_rng(2).random((4000, 150)) < probabilities
    r = np.corrcoef(np.tile(probabilities, 4000), outcomes.ravel())[0, 1]
    assert worth_of(table, before, after).control_variate == pytest.approx(1 / (1 - r**2), rel=0.02)
