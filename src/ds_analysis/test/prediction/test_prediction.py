"""Predictions of a simulator that was never driven, on populations whose boundaries are known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from prediction_tables import alike, made_up, table_of_margins
from scipy.integrate import quad
from scipy.stats import norm
from sklearn.metrics import average_precision_score

from ds_analysis.common import weighted_scores as scores
from ds_analysis.common.outcome_table import OutcomeTableError
from ds_analysis.prediction.calibration import forecast_cells
from ds_analysis.prediction.margins import INSIDE, curvature_of, margins_of
from ds_analysis.prediction.predictor_scores import compare_predictors, comparison_tables
from ds_analysis.prediction.predictors import undriven_probabilities
from ds_analysis.prediction.twin_prediction import MarginDrive, TwinPrediction, predict_twin
from ds_analysis.prediction.verdicts import TOLERATED_RATE, drives_needed, judge

Array = NDArray[np.float64]


def test_weighted_scores_are_those_of_repeated_rows() -> None:
    rng = np.random.default_rng(4)
    predicted, truth = np.round(rng.random(60), 1), (rng.random(60) < 0.4).astype(float)
    weights = scores.family_weights(np.arange(60) // 4, 5, 1)
    assert weights.shape == (6, 60) and (weights[0] == 1).all()
    assert (weights.sum(axis=1) == 60).all() and (weights.reshape(6, 15, 4).std(axis=2) == 0).all()
    for k, row in enumerate(weights):
        again = np.repeat(np.arange(60), row.astype(int))
        p, y = predicted[again], truth[again]
        assert scores.brier(predicted, truth, weights)[k] == pytest.approx(np.mean((p - y) ** 2))
        assert scores.pearson(predicted, truth, weights)[k] == pytest.approx(np.corrcoef(p, y)[0, 1])
        area = average_precision_score(y, p)
        assert scores.average_precision(predicted, truth, weights)[k] == pytest.approx(area)
        stacked = np.tile(predicted, (6, 1)), np.tile(truth, (6, 1))
        assert scores.average_precision(*stacked, weights)[k] == pytest.approx(area)
        assert scores.recall(predicted, truth, weights, 0.5)[k] == pytest.approx(np.mean(p[y > 0] >= 0.5))
        assert scores.false_alarms(predicted, truth, weights, 0.5)[k] == pytest.approx(np.mean(p[y == 0] >= 0.5))


def test_the_likelihood_is_that_of_numerical_integration() -> None:
    """Test effects integrated out by scipy's adaptive quadrature; derivatives by differences of the result."""
    table, truth = made_up(1, tests=14)
    margins = margins_of(table)
    linear = margins.predictors @ (truth.coefficients[:3] + 0.1).T
    sigma, omega = 0.3, 0.25
    assert {-1, 0, 1} == set(margins.signs.ravel().tolist())

    def density(effect: float, test: int, shift: Array) -> float:
        found = norm.pdf(effect, scale=omega)
        for s in range(3):
            centre, sign = float(linear[test, s] + shift[s]) + effect, int(margins.signs[test, s])
            off = (margins.values[test, s] - centre) / sigma
            found *= norm.pdf(off) / sigma if sign == 0 else norm.cdf(-sign * off)
        return float(found)

    def log_density(test: int, shift: Array) -> float:
        return float(np.log(quad(density, -2, 2, args=(test, shift), points=[-0.3, 0, 0.3], epsabs=1e-12)[0]))

    found = curvature_of(margins, linear, sigma, omega)
    assert found.log_likelihood == pytest.approx(sum(log_density(k, np.zeros(3)) for k in range(14)), abs=1e-4)
    step = 1e-2 * np.eye(3)
    for k in range(14):
        at = log_density(k, np.zeros(3))
        for s in range(3):
            above, below = log_density(k, step[s]), log_density(k, -step[s])
            assert found.gradient[k, s] == pytest.approx((above - below) / 2e-2, abs=5e-3)
            assert found.information[k, s, s] == pytest.approx(-(above - 2 * at + below) / 1e-4, abs=2e-2)
        mixed = log_density(k, step[0] + step[1]) - log_density(k, step[0] - step[1])
        mixed -= log_density(k, step[1] - step[0]) - log_density(k, -step[0] - step[1])
        assert found.information[k, 0, 1] == pytest.approx(-mixed / 4e-4, abs=2e-2)


def test_the_siblings_boundaries_come_back() -> None:
    table, truth = made_up(5, tests=3000)
    found = predict_twin(table, in_turn=False).population
    centred = truth.coefficients[:3].copy()  # features are standardised before the fit
    centred[:, 0] += centred[:, 1:] @ table.features.mean(axis=0)
    centred[:, 1:] *= table.features.std(axis=0)
    errors = np.sqrt(np.diagonal(found.sibling_covariances, axis1=1, axis2=2).mean(axis=0)).reshape(centred.shape)
    assert np.abs((found.sibling_means - centred) / errors).max() < 3.5 and errors.max() < 0.05
    assert found.omega == pytest.approx(truth.omega, abs=0.03)
    assert found.sigma == pytest.approx(truth.sigma, abs=0.03)
    off = found.effect_mean - truth.effects
    assert np.std(off) == pytest.approx(np.sqrt(found.effect_variance.mean()), rel=0.1)
    # The population's own parameters are within what three siblings can tell.
    assert (np.abs(found.mean - [-0.5, 0.3, 0.2, -0.2, 0.1]) < 3 * found.mean_error).all()


def test_one_more_simulator_is_what_brute_force_says() -> None:
    """Without features: prior draws of mean and spread, weighted by the likelihood of the siblings' mean margins."""
    rng = np.random.default_rng(6)
    levels = np.array([-0.45, -0.3, -0.25])
    shared, own = 0.05 * rng.normal(size=(80, 1)), 0.03 * rng.normal(size=(80, 4))
    margins = np.array([*levels, -0.3]) + shared + own  # all known: within the lane, but not well within
    prediction = alike(predict_twin(table_of_margins(margins, np.zeros((80, 1))), in_turn=False))
    population, known = prediction.population, margins[:, :3].mean(axis=0)
    error = (population.omega**2 * np.ones((3, 3)) + population.sigma**2 * np.eye(3)) / 80
    mean, tau = rng.normal(np.log(0.25), 2.0, 200_000), np.abs(rng.normal(0.0, 1.0, 200_000))
    total = error + tau[:, None, None] ** 2 * np.eye(3)
    off = known - mean[:, None]
    log_weight = -0.5 * np.einsum("ni,nij,nj->n", off, np.linalg.inv(total), off) - 0.5 * np.linalg.slogdet(total)[1]
    weight = np.exp(log_weight - log_weight.max())
    # Given mean and spread, one more simulator is a draw from the population.
    first = float(weight @ mean / weight.sum())
    second = float(np.sqrt(weight @ ((mean - first) ** 2 + tau**2) / weight.sum()))
    mixture = prediction.coefficients
    ours = float(mixture.weights @ mixture.means[:, 0])
    spread = np.sqrt(mixture.weights @ (mixture.covariances[:, 0, 0] + (mixture.means[:, 0] - ours) ** 2))
    assert ours == pytest.approx(first, abs=0.02) and spread == pytest.approx(second, rel=0.15)
    # It reaches beyond the siblings, either way.
    assert ours - spread < levels.min() and ours + spread > levels.max()


@pytest.mark.long
def test_intervals_of_a_simulator_that_was_never_driven_hold_what_they_say() -> None:
    """A known population, drawn twenty times: 90 % intervals hold 85 to 95 % of the rates of cells."""
    forecasts = []
    for seed in range(20):
        table, _ = made_up(100 + seed, tests=120, tau=(0.67, 0.17))  # the medians of their priors
        forecasts += forecast_cells(table, predict_twin(table, in_turn=False), fewest=5)
    assert len(forecasts) > 150
    ranks = np.array([one.rank for one in forecasts])
    assert 0.85 <= np.mean((ranks >= 0.05) & (ranks <= 0.95)) <= 0.95
    # Rates of few tests take few values, so that intervals of them hold more than they say.
    assert np.mean([bool(one.holds) for one in forecasts]) >= 0.88


def test_the_prediction_is_the_same_on_every_call() -> None:
    table, _ = made_up(7, tests=60)
    one, two = predict_twin(table), predict_twin(table)
    assert (
        one.probabilities().tobytes() == two.probabilities().tobytes()
        and one.draws().tobytes() == two.draws().tobytes()
    )
    assert one.draws().mean(axis=0) == pytest.approx(one.probabilities(), abs=0.02)


def test_the_twin_s_outcomes_are_never_looked_at() -> None:
    table, _ = made_up(8, tests=60)
    states, lateral = table.states.copy(), table.lateral.copy()
    states[:, -1], lateral[:, -1] = 3 - states[:, -1], 1.0
    other = replace(table, states=states, lateral=lateral)
    assert (predict_twin(table).probabilities() == predict_twin(other).probabilities()).all()
    assert (undriven_probabilities(table, "all") == undriven_probabilities(other, "all")).all()


def test_drives_update_as_a_bayesian_regression_does() -> None:
    """Every component against the textbook's formula; the order of the drives does not matter."""
    table, truth = made_up(9, tests=60)
    prediction = alike(predict_twin(table, in_turn=False))
    rows = [int(k) for k in np.flatnonzero((truth.margins[:, 3] < 0) & (truth.margins[:, 3] > INSIDE))[:4]]
    drives = [MarginDrive(row=k, failed=False, margin=float(truth.margins[k, 3])) for k in rows]
    found = prediction.updated(drives)
    x, before = prediction.margins.predictors[rows], prediction.coefficients
    for k in range(0, len(before.sigmas), 17):
        noise = np.diag(prediction.population.effect_variance[rows] + before.sigmas[k] ** 2)
        y = truth.margins[rows, 3] - prediction.population.effect_mean[rows]
        precision = np.linalg.inv(before.covariances[k]) + x.T @ np.linalg.inv(noise) @ x
        right = np.linalg.inv(before.covariances[k]) @ before.means[k] + x.T @ np.linalg.inv(noise) @ y
        assert found.coefficients.means[k] == pytest.approx(np.linalg.solve(precision, right), abs=1e-8)
        assert found.coefficients.covariances[k] == pytest.approx(np.linalg.inv(precision), abs=1e-8)
    again = prediction.updated(drives[2:]).updated(drives[:2])
    assert again.coefficients.means == pytest.approx(found.coefficients.means)
    assert again.log_evidence == pytest.approx(found.log_evidence)


def test_a_verdict_alone_updates_as_weighted_draws_do() -> None:
    table, _ = made_up(10, tests=60)
    prediction = predict_twin(table)
    row = int(np.argmin(np.abs(prediction.probabilities() - 0.4)))
    draws = prediction.draws(20_000)
    weights = draws[:, row] / draws[:, row].sum()
    found = prediction.updated([MarginDrive(row=row, failed=True)]).probabilities()
    assert found[row] == 1.0
    others = np.arange(60) != row
    assert found[others] == pytest.approx((weights @ draws)[others], abs=0.02)
    assert prediction.updated([MarginDrive(row=row, failed=True)]).log_evidence == pytest.approx(
        np.log(prediction.probabilities()[row])
    )


def briers(prediction: TwinPrediction, truth: Array, driven: NDArray[np.intp]) -> tuple[float, float]:
    drives = [
        MarginDrive(row=int(k), failed=bool(truth[k] > 0), margin=float(truth[k]) if truth[k] <= 0 else None)
        for k in driven
    ]
    left = np.setdiff1d(np.arange(len(truth)), driven)
    failed = (truth > 0)[left]
    before, after = prediction.probabilities()[left], prediction.updated(drives).probabilities()[left]
    return float(np.mean((before - failed) ** 2)), float(np.mean((after - failed) ** 2))


def test_a_few_drives_help_with_a_twin_outside_and_do_no_harm_with_a_twin_like_a_sibling() -> None:
    outside, same = [], []
    for seed in range(12):
        table, truth = made_up(200 + seed, tests=120, twin=np.array([0.5, 0.3, 0.2, -0.2, 0.1]))
        chosen = np.random.default_rng(seed).permutation(120)[:4]
        outside.append(briers(predict_twin(table, in_turn=False), truth.margins[:, 3], chosen))
        copy = truth.margins[:, 0] + 0.05 * np.random.default_rng(seed).normal(size=120)
        same.append(briers(predict_twin(table, in_turn=False), copy, chosen))
    before, after = np.mean(outside, axis=0)
    assert after < before - 0.05
    before, after = np.mean(same, axis=0)
    assert after < before + 0.005


def test_predictors_are_scored_and_only_those_that_beat_the_baseline_add() -> None:
    """A twin equal to a sibling, whose failures no feature predicts: the sibling adds. One made of noise does not."""
    rng = np.random.default_rng(11)
    features, hidden = rng.normal(size=(200, 2)), rng.normal(size=200)
    margins = np.column_stack((hidden, rng.normal(size=200), hidden + 0.05 * rng.normal(size=200)))
    found = compare_predictors(table_of_margins(margins, features))
    by_name = {one.predictor: one for one in found.scores if one.level == "test"}
    assert by_name["a"].verdict == "adds" and by_name["b"].verdict == "worse"
    assert by_name["undriven features"].verdict == "baseline" and by_name["best single feature"].verdict == "undriven"
    truth: NDArray[np.bool_] = margins[:, 2] > 0
    assert by_name["a"].brier == pytest.approx(np.mean((margins[:, 0] > 0) != truth))
    assert by_name["product"].recall[0] == pytest.approx((margins[truth, :2] > 0).all(axis=1).mean())
    assert by_name["maximum"].false_alarms[0] == pytest.approx((margins[~truth, :2] > 0).any(axis=1).mean())
    assert {one.level for one in found.scores} == {"test", "cell"}
    json.dumps(found.document(), allow_nan=False)
    for table in comparison_tables(found):
        assert table.csv() and table.latex() and all(len(row) == len(table.columns) for row in table.rows)


def test_undriven_probabilities_come_from_other_families() -> None:
    """One family fails everywhere, for no reason that a feature tells; it cannot predict itself."""
    rng = np.random.default_rng(12)
    margins = -np.ones((100, 3))
    margins[:20] = 1.0
    features = rng.normal(size=(100, 1))
    features[:20] = 9.0
    found = undriven_probabilities(table_of_margins(margins, features, family=20), "all")
    assert found[:20].max() < 0.1


def test_a_campaign_of_one_sibling_and_one_without_a_twin_are_predicted() -> None:
    table, _ = made_up(13, tests=60, siblings=1)
    alone = predict_twin(table).probabilities()
    assert np.isfinite(alone).all() and alone.min() > 0.0 and alone.max() < 1.0
    untwinned = table.with_twin(None)
    assert untwinned.twin is None and untwinned.simulators == ("a",)
    assert (predict_twin(untwinned).probabilities() == alone).all()
    with pytest.raises(OutcomeTableError, match="there is no twin to compare predictions with"):
        compare_predictors(untwinned)
    with pytest.raises(OutcomeTableError, match="5 tests have a verdict on a sibling, expected at least 10"):
        predict_twin(table.select(np.arange(5)))


@pytest.mark.parametrize("level", [-1.5, 1.5])
def test_siblings_that_all_agree_are_predicted(level: float) -> None:
    """No failure at all, or nothing else: no boundary is seen, and the prediction stays finite and on its side."""
    rng = np.random.default_rng(14)
    margins = level + 0.2 * rng.normal(size=(60, 4))
    found = predict_twin(table_of_margins(margins, rng.normal(size=(60, 3)))).probabilities()
    assert np.isfinite(found).all() and ((found < 0.3) if level < 0 else (found > 0.6)).all()


def test_verdicts_keep_their_error_rates() -> None:
    """Of tests called `fails` or `safe` for one more simulator that is alike, at most one in twenty does otherwise."""
    calls, wrong = 0, 0
    for seed in range(12):
        table, truth = made_up(300 + seed, tests=120)
        found = judge(table, alike(predict_twin(table, in_turn=False)))
        for one, margin in zip(found.tests, truth.margins[:, 3], strict=True):
            if one.verdict in ("fails", "safe"):
                calls += 1
                wrong += (margin > 0) != (one.verdict == "fails")
    assert calls > 100 and wrong / calls <= 0.05


def test_cells_without_tests_are_untested_and_disputed_ones_say_what_they_need() -> None:
    table, _ = made_up(15, tests=60)
    cells = tuple((0, 0) if cell == (1, 1) else cell for cell in table.cells)
    table = replace(table, cells=cells)
    found = judge(table, predict_twin(table, in_turn=False))
    by_cell = {one.cell: one for one in found.cells}
    assert by_cell[(1, 1)].verdict == "untested" and by_cell[(1, 1)].rate is None
    disputed = [one for one in found.cells if one.verdict == "disputed"]
    assert disputed and all(one.drives_needed is None or one.drives_needed > 0 for one in disputed)
    assert sum(found.counts.values()) == len(found.cells) and "untested" in found.sentence
    json.dumps(found.document(), allow_nan=False)


def needed(mean: float, variance: float) -> int | None:
    return drives_needed(mean, variance, TOLERATED_RATE)


def test_drives_needed_are_those_that_a_binomial_needs() -> None:
    """A flat prior, and a rate of 0: one needs 28 tests without a failure for 95 % below 0.1 (0.9^29 < 0.05)."""
    assert needed(1e-6, 1e-13) == 0
    mean, variance = 0.5, 1 / 12  # the uniform distribution
    assert needed(mean, variance) is not None and needed(mean, variance) < 10  # type: ignore[operator]
    assert needed(0.1, 0.001) is None  # on the tolerated rate itself
    small = needed(0.03, 0.03 * 0.97 / 3)
    assert small is not None and 20 < small < 200


def test_covariances_stay_positive_where_quadrature_is_coarse() -> None:
    """A residual spread far below that of test effects: quadrature alone gives the log-concave likelihood dents."""
    from ds_analysis.prediction import population

    table, _ = made_up(1, tests=40)
    margins = margins_of(table)
    start = np.tile(np.concatenate(([np.log(0.25)], np.zeros(4))), 4)
    for sigma, omega in ((0.05, 1.0), (0.1, 3.0)):
        point = population._point(margins, 0.5, 0.15, sigma, omega, start)
        assert np.linalg.eigvalsh(point.covariance).min() > 0.0
