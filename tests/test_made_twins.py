"""Cars that the benchmark of real drives makes: the same ones for the same seed, within their ranges, and drivable."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.prediction.budget_scores import RATE, SEED, SHIFT_SCALE, SHIFTED, Case, learned, pooled, score
from benchmarks.prediction.made_twins import EVERY, OUTSIDE, WIDE, WITHIN, made_twin
from benchmarks.prediction.real_budget import SIMULATORS, BudgetTest, Runs, cases_of, draw_tests
from scipy.stats import bernoulli, beta, norm

from ds_analysis.common.driven_road import DrivenRoad
from ds_analysis.common.outcome_table import OutcomeTable, State
from ds_road import generate
from ds_sim.conditions.model import DEFAULT
from ds_sim.registry import SimulatorName, make_simulator
from ds_sim.simulator import Outcome
from ds_twin_donkey.parameter_file import read_parameters


def test_twins_are_those_of_their_seed_and_lie_in_their_ranges(tmp_path: Path) -> None:
    twins = [made_twin(number, SEED) for number in range(1, 21)]
    assert twins == [made_twin(number, SEED) for number in range(1, 21)] and twins[0] != made_twin(1, SEED + 1)
    assert [twin.outside for twin in twins if twin.outside] == list(OUTSIDE)
    for twin in twins:
        for name, (low, high) in WITHIN.items():
            assert (low <= twin.values[name] <= high) == (name != twin.outside)
        assert bool(twin.outside) == (twin.number % EVERY == 0)
    simulator = twins[3].simulator(tmp_path / "twins")
    parameters, _ = read_parameters(Path(SimulatorName.parse(simulator).file))
    assert parameters == twins[3].parameters and parameters.max_steering_angle < np.radians(23.1)
    made = make_simulator(simulator)
    assert made.spec.extra["car"]
    made.close()


def test_wide_twins_fill_their_ranges_and_can_be_made(tmp_path: Path) -> None:
    twins = [made_twin(number, SEED, "wide") for number in range(1, 21)]
    for name, (low, high) in WIDE.items():
        shares = [(twin.values[name] - low) / (high - low) for twin in twins]
        assert 0.0 <= min(shares) < 0.2 and 0.8 < max(shares) <= 1.0
    parameters, _ = read_parameters(Path(SimulatorName.parse(twins[0].simulator(tmp_path)).file))
    assert parameters == twins[0].parameters and parameters.steering_trim == twins[0].values["steering_trim"]
    assert {twin.name for twin in twins}.isdisjoint(made_twin(number, SEED).name for number in range(1, 21))


def test_a_twin_is_scored_and_outcomes_of_drives_count_for_every_predictor(monkeypatch: pytest.MonkeyPatch) -> None:
    """A twin that fails everywhere: without drives every predictor errs, with all drives known none does."""
    monkeypatch.setattr("benchmarks.prediction.budget_scores.CHOICES", 2)
    rng = np.random.default_rng(3)
    roads = tuple(generate(rng, max_angle=200) for _ in range(16))
    failed = np.column_stack((rng.random((16, 3)) < 0.3, np.ones(16, bool)))
    states = np.where(failed, State.FAILED, State.COMPLETED).astype(np.int8)
    table = OutcomeTable.of(roads, states, np.where(failed, 2.0, 1.2), siblings=("a", "b", "c"), twin="d")
    found = score(Case(network="none", group="made", name="d", outside="", table=table, clusters=table.test_ids))
    driven = failed[:, :3].mean(axis=1)
    assert found.plain["mean"] == pytest.approx((driven - 1.0) ** 2)
    for rule in ("information", "disagreement", "random"):
        assert all(errors.max() == 0.0 for errors in found.after[rule, 16].values())
        four = found.after[rule, 4]
        assert four["mean"].sum() < found.plain["mean"].sum()
        assert four["hierarchical model"].mean() < found.plain["hierarchical model"].mean()
    # Failures that follow nothing: no drive is expected to tell of another test, so the rule asks for none.
    drives, brier, last = found.stopped
    assert drives == 0 and brier == pytest.approx(found.plain["hierarchical model"].mean()) and last == 0.0
    mean, (low, high) = pooled([(found.case, found.plain["mean"])])
    assert mean == pytest.approx(found.plain["mean"].mean()) and low < mean < high
    # Five copies of each test, resampled with it, are no more evidence than one; five unrelated tests are.
    five = np.repeat(np.arange(16), 5)
    errors = found.plain["mean"][five]
    copies = replace(found.case, clusters=tuple(table.test_ids[k] for k in five))
    again, ends = pooled([(copies, errors)])
    assert (again, *ends) == pytest.approx((mean, low, high))
    _, (lowest, highest) = pooled([(replace(copies, clusters=tuple(map(str, range(80)))), errors)])
    assert highest - lowest < 0.6 * (high - low)


def test_simple_learners_predict_what_follows_from_the_outcomes_alone() -> None:
    undriven = np.array([0.1, 0.3, 0.5, 0.7, 0.2, 0.9])
    truth = np.array([1.0, 0.0, 1.0, 1.0, 0.0, 1.0])
    found = learned(undriven, truth, [0, 3, 4])
    posterior = beta(2 + 0.5, 1 + 0.5)  # of two failures in three drives
    assert found[RATE] == pytest.approx([1.0, posterior.mean(), posterior.mean(), 1.0, 0.0, posterior.mean()])
    shifts = np.linspace(-5.0, 5.0, 100_001)
    odds = undriven / (1.0 - undriven)
    scores = norm(0.0, SHIFT_SCALE).logpdf(shifts)
    for row in (0, 3, 4):
        probability = odds[row] * np.exp(shifts) / (1.0 + odds[row] * np.exp(shifts))
        scores += bernoulli(probability).logpmf(int(truth[row]))
    moved = odds * np.exp(shifts[scores.argmax()])
    assert found[SHIFTED][[1, 2, 5]] == pytest.approx((moved / (1.0 + moved))[[1, 2, 5]], abs=1e-4)
    assert found[SHIFTED][[0, 3, 4]].tolist() == [1.0, 1.0, 0.0]
    assert learned(undriven, truth, [])[SHIFTED] == pytest.approx(undriven)


def test_tests_with_conditions_are_cases_where_every_simulator_lets_them_be_judged() -> None:
    plain, tests = draw_tests(6, conditions=False), draw_tests(6, conditions=True)
    assert [test.road for test in tests] == [test.road for test in plain]
    assert all(test.conditions == DEFAULT for test in plain) and tests == draw_tests(8, conditions=True)[:6]
    runs: Runs = {name: [_run(test, failed=k == 5) for k, test in enumerate(tests)] for name in SIMULATORS}
    valid = {name: [True] * 6 for name in SIMULATORS}
    valid["panda"][1], runs["panda"][1] = False, None
    cases = {case.name: case.table for case in cases_of("none", runs, valid, tests, [], SIMULATORS[:3])}
    kept = [tests[k].road.road_id for k in (0, 2, 3, 4, 5)]
    assert list(cases["donkey"].test_ids) == kept and cases["donkey"].failed("donkey").tolist() == [False] * 4 + [True]
    assert {"line_contrast", "visibility"} <= set(cases["donkey"].feature_names)
    assert cases["donkey"].conditions == tuple(tests[k].conditions for k in (0, 2, 3, 4, 5))
    # Where a drive is missing, no case is complete but those that do without its simulator.
    runs["donkey"][3] = None
    cases = {case.name: case.table for case in cases_of("none", runs, valid, tests, [], SIMULATORS[:3])}
    assert sorted(cases) == ["bullet again", "panda again", "softbody again"]


def _run(test: BudgetTest, *, failed: bool) -> DrivenRoad:
    outcome = Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED
    return DrivenRoad(road=test.road, outcome=outcome)
