# SPDX-License-Identifier: Apache-2.0
"""Predictions of a car by independent arithmetic, known populations and tables, and a few drives on a real one."""

from __future__ import annotations

import csv
import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from prediction_tables import ROAD, made_up, real_drive, table_of_margins
from report_campaigns import make_campaign, set_conditions
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import beta, norm
from sklearn.metrics import average_precision_score

from ds_analysis.common.outcome_table import ROAD_FEATURES, OutcomeTable, OutcomeTableError, State, table_of_campaign
from ds_analysis.common.statistics import Array, Bools, Indices, families_of
from ds_analysis.prediction.car import CarPrediction, drives_in_order, sibling_help
from ds_analysis.prediction.certificate import ALPHA, Bet, certify, drives_until
from ds_analysis.prediction.experts import RateExpert, SiblingOutcomes, experts_of, fit_logistic
from ds_analysis.prediction.mixture import Drive, Prediction, predict
from ds_analysis.prediction.predictors import compare_predictors, comparison_tables, features_alone
from ds_analysis.prediction.verdicts import judge
from ds_analysis.real.proposal import BudgetError, Proposed, ProposedDrive, propose, read_proposed
from ds_analysis.real.records import RealDrive, RecordError, added, read_csv
from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig
from ds_orchestrator.campaign.folder import CampaignData, read_campaign
from ds_report.drives_on_the_car import draw_sheet, sheet_of, write_drives_to_do
from ds_road import MutationError, generate, mutate
from ds_sim import BULLET, DONKEY, PANDA, SimulatorName
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import parse_conditions
from ds_sim.gates.gate import not_applicable
from ds_sim.simulator import Outcome


def drives_of(table: OutcomeTable, rows: Indices) -> list[Drive]:
    failed = table.failed(SimulatorName("twin"))
    return [Drive(int(row), bool(failed[row]), drawn=True) for row in rows]


def test_the_logistic_fit_is_that_of_a_general_optimiser() -> None:
    rng = np.random.default_rng(1)
    design = np.column_stack((np.ones(30), rng.normal(size=(30, 2))))
    failed = (rng.random(30) < expit(design @ [0.5, 1.0, -1.0])).astype(float)
    mean, precision = np.array([0.2, 0.5, 0.0]), np.array([0.5, 4.0, 1.0])

    def loss(b: Array) -> float:
        x = design @ b
        return float(np.sum(np.logaddexp(0.0, x) - failed * x) + 0.5 * precision @ (b - mean) ** 2)

    mode, covariance, _ = fit_logistic(design, failed, mean, precision)
    best = minimize(loss, mean, method="BFGS", options={"gtol": 1e-9})
    assert mode == pytest.approx(best.x, abs=1e-5)
    share = expit(design @ best.x)
    hessian = design.T @ np.diag(share * (1.0 - share)) @ design + np.diag(precision)  # McCullagh and Nelder
    assert covariance == pytest.approx(np.linalg.inv(hessian), rel=1e-3, abs=1e-4)


def test_evidence_and_probabilities_are_nearly_those_of_quadrature() -> None:
    design, failed = np.ones((12, 1)), np.array([1.0] * 3 + [0.0] * 9)

    def joint(level: float) -> float:
        return float(expit(level) ** 3 * expit(-level) ** 9 * norm.pdf(level, 0.5, 2.0))

    evidence = quad(joint, -12, 12)[0]
    _, _, log_evidence = fit_logistic(design, failed, np.array([0.5]), np.array([0.25]))
    assert log_evidence == pytest.approx(np.log(evidence), abs=0.05)  # Laplace's approximation
    rate = quad(lambda level: joint(level) * expit(level), -12, 12)[0] / evidence
    outcomes = SiblingOutcomes(
        features=np.zeros((12, 0)), failed=failed[:, None] > 0, known=np.ones((12, 1), bool), margins=np.zeros((12, 1))
    )
    wide = next(expert for expert in experts_of(outcomes) if expert.name == "own features")
    learnt = wide.after(np.arange(12), failed)
    assert learnt.probabilities(np.array([0]))[0] == pytest.approx(rate, abs=0.02)


def test_the_rate_is_jeffreys_posterior() -> None:
    learnt = RateExpert().after(np.arange(10), np.array([1.0] * 2 + [0.0] * 8))
    assert learnt.probabilities(np.arange(3)) == pytest.approx([2.5 / 11.0] * 3)
    draws = learnt.draws(np.random.default_rng(2), 40_000, np.arange(2))
    assert np.quantile(draws[:, 0], (0.05, 0.95)) == pytest.approx(beta.ppf((0.05, 0.95), 2.5, 8.5), abs=0.01)
    # The evidence of drives one after the other is the product of their predictions.
    predicted = [(0.5, 1), (1.5 / 2, 1), *((0.5 + 1 - (2.5 / (3 + k)) - 0.5, 0) for k in range(8))]
    assert learnt.log_evidence == pytest.approx(sum(np.log(p) for p, _ in predicted))


def test_the_prediction_is_the_same_on_every_call_and_its_draws_have_its_mean() -> None:
    table = made_up(7, tests=60)
    one, two, rows = predict(table), predict(table), np.arange(60)
    assert one.probabilities().tobytes() == two.probabilities().tobytes()
    assert one.draws(rows).tobytes() == two.draws(rows).tobytes()
    assert one.draws(rows).mean(axis=0) == pytest.approx(one.probabilities(), abs=0.03)
    assert sum(one.shares.values()) == pytest.approx(1.0)


def test_the_twin_s_outcomes_are_never_looked_at() -> None:
    table = made_up(8, tests=60)
    states, lateral = table.states.copy(), table.lateral.copy()
    states[:, -1], lateral[:, -1] = 3 - states[:, -1], 1.0
    other = replace(table, states=states, lateral=lateral)
    assert (predict(table).probabilities() == predict(other).probabilities()).all()
    assert (features_alone(table) == features_alone(other)).all()


def test_drives_count_in_any_order_and_are_known() -> None:
    table = made_up(9, tests=60)
    drives = drives_of(table, np.arange(0, 12))
    one, two = predict(table).updated(drives), predict(table).updated(drives[7:]).updated(drives[:7])
    assert one.probabilities() == pytest.approx(two.probabilities(), abs=1e-9)
    assert one.probabilities()[:12].tolist() == table.failed("twin")[:12].astype(float).tolist()


def test_a_few_drives_help_with_a_car_outside_and_do_no_harm_with_one_like_a_sibling() -> None:
    changes: dict[str, list[float]] = {"outside": [], "alike": []}
    for seed in range(12):
        for kind, car in (("outside", np.array([0.9, 0.3, 0.2, -0.2, 0.1])), ("alike", None)):
            table = made_up(200 + seed, tests=120, car=car)
            truth, rows = table.failed("twin"), np.random.default_rng(seed).permutation(120)
            before = predict(table)
            after = before.updated(drives_of(table, rows[:6]))
            left = rows[6:]
            errors = [float(np.mean((one.probabilities(left) - truth[left]) ** 2)) for one in (before, after)]
            changes[kind].append(errors[1] - errors[0])
    assert np.mean(changes["outside"]) < -0.03 and np.mean(changes["alike"]) < 0.005


def test_calls_are_wrong_at_most_as_often_as_stated() -> None:
    """Of tests called `fails` or `safe` of one more simulator of a population, after a few drives."""
    calls, wrong = 0, 0
    for seed in range(16):
        table = made_up(300 + seed, tests=120)
        prediction = predict(table).updated(drives_of(table, np.random.default_rng(seed).permutation(120)[:8]))
        truth = dict(zip(table.test_ids, table.failed("twin"), strict=True))
        for one in judge(table.with_twin(None), prediction).undriven:
            if one.verdict in ("fails", "safe"):
                calls += 1
                wrong += truth[one.test_id] != (one.verdict == "fails")
    assert calls > 100 and wrong / calls <= 0.05


def test_capital_is_the_product_of_ratios_and_a_chosen_drive_bets_on_its_verdict() -> None:
    table = made_up(21, tests=40)
    undriven = predict(table)
    drives = [*drives_of(table, np.array([3, 11])), Drive(5, True)]
    found = sibling_help(undriven, undriven.updated(drives))
    capital, left = 1.0, list(range(40))
    for k, (row, failed, drawn) in enumerate(drives):
        ratio = 1.0
        for siblings in (True, False):
            p = undriven.only(siblings=siblings).updated(drives[:k]).probabilities()
            p = np.clip(p if failed else 1.0 - p, 0.005, 0.995)
            share = p[row] / (p[left].mean() if drawn else 1.0)
            ratio *= share if siblings else 1.0 / share
        capital *= ratio
        left.remove(row)
    assert found.capital == pytest.approx(capital) and found.drives == 3
    assert found.answer == "open" and "open whether your simulators" in found.sentence
    won = replace(found, helped=2.0 / ALPHA, capital=5.0)
    assert won.answer == "helped" and "have helped" in won.sentence and "at most 5%" in won.sentence
    assert sibling_help(undriven, undriven).sentence == ""


def test_predictors_are_scored_and_only_those_that_beat_the_baseline_add() -> None:
    """A twin equal to a sibling, whose failures no feature predicts: the sibling adds. One made of noise does not."""
    rng = np.random.default_rng(11)
    features, hidden = rng.normal(size=(200, 2)), rng.normal(size=200)
    margins = np.column_stack((hidden, rng.normal(size=200), hidden + 0.05 * rng.normal(size=200)))
    table = table_of_margins(margins, features)
    found = compare_predictors(table, predict(table))
    by_name = {one.predictor: one for one in found.scores}
    assert by_name["a"].verdict == "adds" and by_name["b"].verdict == "worse"
    assert by_name["features alone"].verdict == "baseline" and by_name["prediction"].verdict == "adds nothing"
    truth: NDArray[np.bool_] = margins[:, 2] > 0
    assert by_name["a"].brier == pytest.approx(np.mean((margins[:, 0] > 0) != truth))
    area = average_precision_score(truth, (margins[:, :2] > 0).mean(axis=1))
    assert by_name["mean"].average_precision == pytest.approx(area)
    assert sum(one[2] for one in found.reliability) == found.tests == 200
    json.dumps(found.document(), allow_nan=False)
    for one in comparison_tables(found):
        assert one.csv() and one.latex() and all(len(row) == len(one.columns) for row in one.rows)


def test_features_alone_predict_from_other_families() -> None:
    """One family fails everywhere, for no reason that a feature tells; it cannot predict itself."""
    rng = np.random.default_rng(12)
    margins = -np.ones((100, 3))
    margins[:20] = 1.0
    features = rng.normal(size=(100, 1))
    features[:20] = 9.0
    assert features_alone(table_of_margins(margins, features, family=20))[:20].max() < 0.1


def test_one_sibling_and_tests_that_some_siblings_drove_are_predicted() -> None:
    table = made_up(13, tests=60, siblings=1)
    alone = predict(table).probabilities()
    assert np.isfinite(alone).all() and alone.min() > 0.0 and alone.max() < 1.0
    untwinned = table.with_twin(None)
    assert (predict(untwinned).probabilities() == alone).all()
    with pytest.raises(OutcomeTableError, match="there is no twin to compare predictions with"):
        compare_predictors(untwinned, predict(untwinned))
    with pytest.raises(OutcomeTableError, match="5 tests have a verdict on a sibling, expected at least 10"):
        predict(table.select(np.arange(5)))
    several = made_up(14, tests=60)
    states = several.states.copy()
    states[:30, 0] = states[20:40, 1] = State.MISSING
    assert np.isfinite(predict(replace(several, states=states)).probabilities()).all()
    states[:, 1] = State.MISSING
    with pytest.raises(OutcomeTableError, match="no test has a verdict on b"):
        predict(replace(several, states=states))


@pytest.mark.parametrize("level", [-1.5, 1.5])
def test_siblings_that_all_agree_are_predicted(level: float) -> None:
    """No failure at all, or nothing else: no boundary is seen, and the prediction stays finite and on its side."""
    rng = np.random.default_rng(14)
    margins = level + 0.2 * rng.normal(size=(60, 4))
    found = predict(table_of_margins(margins, rng.normal(size=(60, 3)))).probabilities()
    assert np.isfinite(found).all() and ((found < 0.3) if level < 0 else (found > 0.6)).all()


def test_cells_without_tests_are_untested_and_one_drive_decides_no_cell() -> None:
    table = made_up(15, tests=60)
    table = replace(table, cells=tuple((0, 0) if cell == (1, 1) else cell for cell in table.cells))
    found = judge(table, predict(table).updated([Drive(0, True)]))
    by_cell = {one.cell: one for one in found.cells}
    assert by_cell[(1, 1)].verdict == "untested" and by_cell[(1, 1)].rate is None
    assert sum(found.counts.values()) == len(found.cells) and found.tests[0].driven
    driven = next(one for one in found.cells if one.driven)
    assert driven.interval is not None and driven.interval[0] < driven.interval[1] < 1.0
    json.dumps(found.document(), allow_nan=False)


CONFIG = CampaignConfig(search=SearchConfig(population=10, iterations=0, runs=1))


def data_of(folder: Path) -> CampaignData:
    store = make_campaign(folder, CONFIG, 8, roads=64)
    store.add_error("bullet-0-0001", "bullet", 0, Outcome.SIM_ERROR, "made up")
    data = read_campaign(store)
    store.close()
    return data


def test_families_are_those_of_a_recorded_pedigree() -> None:
    rng = np.random.default_rng(1)
    roads, roots = [generate(rng, max_angle=220) for _ in range(6)], list(range(6))
    while len(roads) < 80:
        parent = int(rng.integers(len(roads)))
        with suppress(MutationError):
            roads.append(mutate(roads[parent], rng))
            roots.append(roots[parent])
    assert families_of(roads).tolist() == roots


def test_a_sample_of_a_large_campaign_has_whole_families_and_says_so(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    whole, sample = table_of_campaign(data), table_of_campaign(data, most=11)
    assert 0 < len(sample) <= 11 and sample.left_out == len(whole) - len(sample)
    assert f"{sample.left_out} tests" in sample.sample_note and whole.sample_note == ""
    rows = [whole.test_ids.index(test_id) for test_id in sample.test_ids]
    assert rows == sorted(rows) and sample.features.tolist() == whole.features[rows].tolist()
    assert not set(whole.families[rows]) & set(np.delete(whole.families, rows))
    assert len(table_of_campaign(data, most=1)) == 1


def test_a_campaign_becomes_a_table(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    table = table_of_campaign(data)
    assert table.simulators == ("bullet", "softbody", "donkey") and len(table) == 16
    assert table.feature_names == tuple(ROAD_FEATURES)
    of_road = [of(data.tests[3].road) for of in ROAD_FEATURES.values()]
    assert table.features[3].tolist() == of_road
    for one in data.verdicts:
        row, column = table.test_ids.index(one.test_id), table.column(one.simulator)
        assert (table.states[row, column] == State.FAILED) == one.outcome.is_failure
        assert table.lateral[row, column] == min(one.max_lateral_position, 2.0)
    # An error that a later attempt fixed leaves the verdict.
    assert table.known(BULLET).all()
    assert table.cells == tuple(data.cells[test_id] for test_id in table.test_ids)


def test_excluded_tests_and_errors_never_count(tmp_path: Path) -> None:
    """The same campaign without the executions of three tests: two excluded, one that only ever ended in errors."""
    data = data_of(tmp_path)
    excluded = {("bullet-0-0000", BULLET): not_applicable("made up"), ("bullet-0-0002", DONKEY): not_applicable("x")}
    gone = {*excluded, ("bullet-0-0001", "bullet")}
    executions = tuple(e for e in data.executions if (e.test_id, e.simulator) not in gone)
    table = table_of_campaign(replace(data, gates=excluded, executions=executions))
    assert [State(s) for s in table.states[:3, 0]][:2] == [State.EXCLUDED, State.ERROR]
    assert not table.known(BULLET)[:2].any() and not table.failed(BULLET)[:2].any()
    assert table.on_siblings.tolist() == [False, False] + [True] * 14
    assert not table.known(DONKEY)[2] and (table.lateral[:2, 0] == 0).all()
    assert table.judged().roads == table.roads[3:]


def test_searched_conditions_are_features_on_their_scale(tmp_path: Path) -> None:
    data = data_of(tmp_path)
    values = (20.0, 40.0, 80.0)
    tests = tuple(
        set_conditions(test, Conditions(visibility=values[k % 3], line_contrast=0.5))
        for k, test in enumerate(data.tests)
    )
    table = table_of_campaign(replace(data, tests=tests))
    assert table.feature_names[-1] == "visibility"  # line_contrast is the same in all
    # The reciprocal is the extinction of the air: 1/20 at the range's lower end, 0 at clear air.
    assert table.features[:3, -1] == pytest.approx([0.0, 0.5, 0.75])


def test_another_simulator_can_play_the_twin(tmp_path: Path) -> None:
    table = table_of_campaign(data_of(tmp_path))
    turned = table.with_twin(BULLET)
    assert turned.siblings == ("softbody", "donkey") and turned.twin == "bullet"
    assert (turned.failed(BULLET) == table.failed(BULLET)).all()
    with pytest.raises(OutcomeTableError, match="no simulator 'panda', expected one of bullet, softbody, donkey"):
        table.with_twin(PANDA)
    with pytest.raises(OutcomeTableError, match="no test has a verdict yet"):
        table_of_campaign(CampaignData(config=CONFIG))


def simulated(seed: int, tests: int, rate: float) -> tuple[OutcomeTable, dict[str, bool]]:
    """Tests that some fail, and the siblings hardly know which; names differ between seeds, and so do draws."""
    rng = np.random.default_rng([seed, int(100 * rate)])
    margins = np.where(rng.random((tests, 1)) < rate, 0.5, -0.5) + 0.4 * rng.normal(size=(tests, 3))
    margins[:, 2] = np.where(rng.random(tests) < rate, 0.5, -0.5)
    table = table_of_margins(margins, rng.normal(size=(tests, 2)), family=1, names=f"s{seed}")
    return table.with_twin(None).select(np.arange(tests)), dict(zip(table.test_ids, margins[:, -1] > 0, strict=True))


def car_of(table: OutcomeTable, drives: list[RealDrive], proposed: Proposed) -> CarPrediction:
    """The car as `predict_car` reads it, predicted by the drives' failure rate alone, which is fast."""
    undriven = Prediction(tests=len(table), experts=(RateExpert(),), prior=np.ones(1))
    ordered = drives_in_order(table, drives, proposed)
    return CarPrediction(
        table=table, undriven=undriven, prediction=undriven.updated(ordered), drives=drives, proposed=proposed
    )


@pytest.mark.parametrize("rate", [0.03, 0.2, 0.6])
def test_the_certificate_holds_whoever_proposes_records_and_stops(tmp_path: Path, rate: float) -> None:
    """Repeated proposals, changed budgets, drives left out or chosen to mislead, and a look after each of them.

    The driver knows which tests fail: he drives failing ones by choice until none is left, and leaves out a drawn test
    that fails now and then. The true number may be outside at any look of one run in twenty.
    """
    wrong, runs, tests = 0, 120, 40
    for seed in range(runs):
        table, truth = simulated(seed, tests, rate)
        rng, folder = np.random.default_rng([9, seed]), tmp_path / str(seed)
        failing, drives, outside = sum(truth.values()), dict[str, RealDrive](), False
        while len(drives) < tests - 6:
            for _ in range(int(rng.integers(1, 4))):  # proposes again before anything is recorded
                budget, driven = int(rng.integers(1, 5)), set(drives)
                left = tests - len({*driven, *read_proposed(folder).tests})
                if left:
                    prediction = car_of(table, list(drives.values()), read_proposed(folder)).prediction
                    propose(folder, table, prediction, driven, min(budget, left), spread=bool(rng.random() < 0.2))
            proposed = read_proposed(folder)
            for test_id in proposed.tests:
                if test_id not in drives and rng.random() < (0.9 if truth[test_id] else 1.0):
                    drives[test_id] = real_drive(test_id, truth[test_id])
            if rng.random() < 0.5:
                chosen = [one for one in truth if truth[one] and one not in drives] or [*({*truth} - {*drives})]
                drives.update({one: real_drive(one, truth[one]) for one in sorted(chosen)[:2]})
            found = car_of(table, list(drives.values()), proposed).certificate
            outside |= found is not None and not found.low <= failing <= found.high
        wrong += outside
    assert wrong / runs <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / runs)


def test_proposals_continue_one_random_order_and_a_drive_counts_once(tmp_path: Path) -> None:
    """Three proposals before anything is recorded are thirty tests; recorded, each of the first ten counts once."""
    table, _ = simulated(1, 132, 0.1)
    undriven = car_of(table, [], Proposed()).undriven
    rounds = [[one.test_id for one in propose(tmp_path, table, undriven, (), 10)] for _ in range(3)]
    assert len({test for one in rounds for test in one}) == 30
    drives = [real_drive(test_id, False) for test_id in rounds[0]]
    car = car_of(table, drives, read_proposed(tmp_path))
    assert car.certificate == certify([Bet(failed=False, drawn=True)] * 10, 132)
    assert list(car.open) == [*rounds[1], *rounds[2]]
    # A file that proposed the same tests thrice, as 0.2 did: still ten drives.
    rows = [[{"test_id": one, "gain": None} for one in rounds[0]]] * 3
    (tmp_path / "real/proposal.json").write_text(json.dumps({"scale": 16.0, "rounds": rows}))
    car = car_of(table, drives, read_proposed(tmp_path))
    assert car.certificate is not None and car.certificate.drawn == 10 and car.open == []
    with pytest.raises(BudgetError, match="123 drives: 122 tests can be proposed"):
        propose(tmp_path, table, undriven, (), 123)


def test_drives_after_one_that_was_left_out_are_not_drawn(tmp_path: Path) -> None:
    table, _ = simulated(2, 40, 0.2)
    order = [one.test_id for one in propose(tmp_path, table, car_of(table, [], Proposed()).undriven, (), 8)]
    drives = [real_drive(test_id, False) for test_id in order if test_id != order[3]]
    ordered = drives_in_order(table, drives, read_proposed(tmp_path))
    assert [one.drawn for one in ordered] == [True] * 3 + [False] * 4
    chosen = next(one for one in table.test_ids if one not in order)
    ordered = drives_in_order(table, [real_drive(chosen, True, drawn=True), *drives], read_proposed(tmp_path))
    assert [one.drawn for one in ordered] == [True] * 3 + [False] * 5


def test_drives_that_were_not_proposed_count_and_certify_only_if_drawn(tmp_path: Path) -> None:
    table, truth = simulated(3, 40, 0.2)
    drives = [real_drive(test_id, truth[test_id]) for test_id in table.test_ids[:5]]
    assert car_of(table, drives, Proposed()).certificate is None
    said = car_of(table, [replace(one, drawn=True) for one in drives], Proposed()).certificate
    assert said is not None and said.drawn == 5 and said.tests == 40
    driven = {one.test_id for one in drives}
    found = [one.test_id for one in propose(tmp_path, table, car_of(table, drives, Proposed()).prediction, driven, 35)]
    assert not driven.intersection(found)
    everything = [*drives, *(real_drive(one, truth[one]) for one in found)]
    last = car_of(table, everything, read_proposed(tmp_path)).certificate
    assert last is not None and last.low == last.high == sum(truth.values()) and last.drawn == 35


def test_an_excluded_test_is_not_proposed(tmp_path: Path) -> None:
    table, _ = simulated(4, 20, 0.3)
    states = table.states.copy()
    states[5, 1], states[6, :] = State.EXCLUDED, State.MISSING
    limited = replace(table, states=states)
    found = propose(tmp_path, limited, car_of(table, [], Proposed()).undriven, (), 18)
    assert {one.test_id for one in found} == {*table.test_ids} - {table.test_ids[5], table.test_ids[6]}


def test_a_road_is_taped_out_at_the_car_s_size() -> None:
    sheet = sheet_of(ROAD, 16.0)
    assert sheet.lane_width == 0.25 and sheet.stations[-1] == pytest.approx(ROAD.length / 16, rel=1e-3)
    rows = list(csv.DictReader(sheet.csv().splitlines()))
    for row in rows[:: len(rows) // 7]:
        left, right, lane, centre = (
            np.array([float(row[f"{name}_{axis}_m"]) for axis in "xy"])
            for name in ("left_edge", "right_edge", "lane_centre", "centre_line")
        )
        assert np.hypot(*(left - right)) == pytest.approx(0.5, abs=0.03)
        assert np.hypot(*(lane - centre)) == pytest.approx(0.125, abs=0.01)
        assert (np.array([left, right]) > 0).all() and (np.array([left, right]) < (sheet.width, sheet.height)).all()
    image = draw_sheet(sheet, "a road")
    assert image.shape[0] > 400 and (image < 60).all(axis=2).mean() > 0.003  # black edges


CSV = "test_id,outcome,who,when,max_lateral_position,note\n"
HALF_LANES = {"a": 2.0, "b": 2.0}


def test_conditions_are_set_in_the_car_s_own_lengths_and_speeds(tmp_path: Path) -> None:
    """Fog of 48 m on the road hides a model's lane like 3 m do; angles, shares, light and time do not scale."""
    conditions = parse_conditions(
        "line_contrast=0.4617371566636695,visibility=48,camera_pitch=3deg,illuminance=1000,speed_limit=4,steering_lag=0.2"
    )
    drive = ProposedDrive(
        test_id="a",
        road=ROAD,
        conditions=conditions,
        features={},
        scale=16.0,
        probability=0.5,
        drawn=True,
        siblings={"bullet": "failed"},
    )
    assert drive.to_set == {
        "line_contrast": "0.462",
        "visibility": "3 m (48 m at full scale)",
        "camera_pitch": "3 degrees",
        "illuminance": "1000 lx",
        "speed_limit": "0.25 m/s (4 m/s at full scale)",
        "steering_lag": "0.2 s",
    }
    assert replace(drive, scale=1.0).to_set["visibility"] == "48 m"
    text = (write_drives_to_do(tmp_path, 1, [drive]) / "README.md").read_text()
    assert all(f"- set {name} to {value}: " in text for name, value in drive.to_set.items())
    assert parse_conditions(drive.document()["conditions"]) == conditions


def test_outcomes_are_read_in_metres_of_the_road(tmp_path: Path) -> None:
    file = tmp_path / "drives.csv"
    file.write_text(CSV + "a,completed,Ada,2026-03-01,0.05,dry\nb,stuck,Ada,2026-03-01T10:00,,\n")
    one, two = read_csv(file, HALF_LANES, scale=16.0)
    assert one.max_lateral_position == pytest.approx(0.8) and not one.failed and one.note == "dry"
    assert two.failed and two.outcome == "stuck" and two.max_lateral_position is None
    file.write_text("test_id,outcome\na,completed\n")
    (one,) = read_csv(file, HALF_LANES, scale=16.0, who="Ada", when="2026-03-01")
    assert one.who == "Ada" and added([one], [one]) == [one]
    file.write_text(CSV + "a,completed,Ada,2026-03-01,,\na,failed,Bob,2026-03-02,,\n")
    with pytest.raises(RecordError, match="test a has two outcomes: completed .Ada, 2026-03-01, drives.csv., and fail"):
        added([], read_csv(file, HALF_LANES, scale=16.0))


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ("c,completed,Ada,2026-03-01,,", "line 2: there is no test 'c': expected one of a, b"),
        ("a,crashed,Ada,2026-03-01,,", "outcome 'crashed': expected one of completed, failed"),
        ("a,completed,,2026-03-01,,", "who is empty: fill it in, or give --who"),
        ("a,completed,Ada,yesterday,,", "when is 'yesterday', expected a date such as 2026-03-01"),
        ("a,completed,Ada,2026-03-01,nan,", "expected metres on the car's road"),
        ("a,completed,Ada,2026-03-01,-1,", "expected metres on the car's road"),
        ("a,completed,Ada,2026-03-01,0.2,", "completed with a lateral position of 0.2 m: the lane's edge is at 0.125"),
        ("a,out_of_bounds,Ada,2026-03-01,0.1,", "out of bounds with a lateral position of 0.1 m"),
        ("", "no rows"),
    ],
)
def test_outcomes_that_cannot_be_are_refused_in_one_line(tmp_path: Path, row: str, named: str) -> None:
    file = tmp_path / "drives.csv"
    file.write_text(CSV + row + ("\n" if row else ""))
    with pytest.raises(RecordError) as caught:
        read_csv(file, HALF_LANES, scale=16.0)
    assert named in str(caught.value) and "\n" not in str(caught.value)


def bets_of(truth: Bools, predicted: Array, order: Indices, drawn: Bools) -> list[Bet]:
    left = np.ones(len(truth), bool)
    found = []
    for row, by_chance in zip(order, drawn, strict=True):
        guess, mean = float(predicted[row]), float(predicted[left].mean())
        found.append(Bet(failed=bool(truth[row]), drawn=bool(by_chance), predicted=guess, mean_predicted=mean))
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
        good, none, bad = np.where(truth, 0.97, 0.03), np.full(200, 0.4), rng.permutation(truth) * 1.0
        for name, predicted in (("good", good), ("none", none), ("bad", bad)):
            found = certify(bets_of(truth, predicted, order, np.ones(60, bool)), 200)
            widths[name].append(found.high - found.low)
    assert np.mean(widths["good"]) < np.mean(widths["none"]) and np.mean(widths["bad"]) < 1.25 * np.mean(widths["none"])


def test_drives_needed_are_those_after_which_the_bound_is_reached() -> None:
    needed = drives_until(0.1, 200)
    assert needed is not None and 24 < needed < 60  # Jeffreys, with a size fixed beforehand: 24
    passes = [Bet(failed=False, drawn=True)]
    assert certify(passes * needed, 200).high <= 20 < certify(passes * (needed - 1), 200).high
    assert drives_until(0.0, 20) == 20
