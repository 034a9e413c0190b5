# SPDX-License-Identifier: Apache-2.0
"""Scores predictors of a car that was driven a few times, on tables of outcomes of ours and of others.

    python -m benchmarks.predictors --foreign FOLDER --out scores         # FOLDER with studies of `ds outcomes import`

Each simulator of a table is the car in turn, predicted from the others. A predictor is a function: of an
`OutcomeTable` without the car's outcomes it makes another one, which gives (tests,) probabilities of failure, of all
tests, for the car's drives so far. The outcomes of driven tests are filled in for every predictor.

Tests are drawn at random (mean of `DRAWS` orders). Scores are Brier scores over all tests, intervals are 95% over cars
and families, resampled together. `calls` counts how often a test is called safe or failing, and is not, and how often
the 90% interval of the number of failures holds it. `help` counts what `ds real update` says of the siblings, of cars
of four kinds: as it is; *control*, its outcomes moved to other tests; *opposite*, which fails where the siblings fail
least; *other*, which follows a feature that they do not.
`benchmarks/foreign` says what the columns of two of others' tables are. Fixed before the tables were scored: tables,
budgets, predictors and every constant of ours.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import expit, log_expit, logit

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import Array, Bools, Indices
from ds_analysis.outcomes.reading import read_table
from ds_analysis.prediction.car import sibling_help
from ds_analysis.prediction.mixture import Drive, Prediction, predict
from ds_analysis.prediction.predictors import FEATURES, features_alone, merged
from ds_analysis.prediction.verdicts import ERROR_RATE
from ds_base.table import Table, Value, styled, write_tables
from ds_cli.output import say

OURS = Path("docs/data/outcomes")
BUDGETS, DRAWS = (0, 4, 8), 6
HELP_BUDGETS, HELP_ORDERS = (12, 25, 50, 100), 3
MOST = 300
"""Tests of a table at most, whole families at random."""
SEED = 37
RESAMPLES = 2000
MODEL, SHIFTED, RATE, MEAN, CONTROL = "ours", "features, shifted", "rate of the drives", "mean", "control variate"
SIMPLE = (FEATURES, SHIFTED, RATE, MEAN, CONTROL)
"""What a prediction must hardly be worse than."""
SHIFT_SCALE = 2.5
"""Standard deviation of a shift's prior in logits; the weakly informative scale of Gelman et al., Ann. Appl. Stat.
2(4), 2008."""
KINDS = ("as it is", "control", "opposite", "other")


Predict = Callable[[Sequence[Drive]], Array]
Predictor = Callable[[OutcomeTable], Predict]
"""What is scored; see the module."""


def ours(siblings: OutcomeTable) -> Predict:
    """`ds predict`."""
    before = predict(siblings)
    return lambda drives: before.updated(drives).probabilities()


def simple(name: str, siblings: OutcomeTable) -> Predict:
    """A rule of `SIMPLE`, or a merge operator on the siblings' verdicts."""
    operator = MEAN if name in (CONTROL, RATE) else name
    if operator in (FEATURES, SHIFTED):
        before = features_alone(siblings)
    else:
        before = merged([siblings.failed(one).astype(np.float64) for one in siblings.siblings])[operator]

    def predicted(drives: Sequence[Drive]) -> Array:
        rows, failed = [one.row for one in drives], np.array([one.failed for one in drives], np.float64)
        if name == RATE:
            return np.full(len(before), (failed.sum() + 0.5) / (len(drives) + 1.0))
        if not drives or name not in (SHIFTED, CONTROL):
            return before
        if name == CONTROL:  # the mean, moved by the drives' mean deviation, as X4Val and Sim2Val correct a mean
            logits = logit(np.clip(before, 0.05, 0.95))
            return np.asarray(expit(logits + 4.0 * float((failed - before[rows]).mean())))
        logits = logit(before)

        def loss(shift: float) -> float:
            moved = logits[rows] + shift
            likelihood = failed @ log_expit(moved) + (1.0 - failed) @ log_expit(-moved)
            return 0.5 * (shift / SHIFT_SCALE) ** 2 - float(likelihood)

        bounds = (-6 * SHIFT_SCALE, 6 * SHIFT_SCALE)
        return np.asarray(expit(logits + float(minimize_scalar(loss, bounds=bounds, method="bounded").x)))

    return predicted


PREDICTORS: Mapping[str, Predictor] = {MODEL: ours, **{name: partial(simple, name) for name in (*SIMPLE, "product")}}
"""By their names in the tables."""


def sample(table: OutcomeTable) -> OutcomeTable:
    """Keep the tests that every simulator judged, `MOST` of them at most, whole families."""
    table = table.as_population()
    table = table.select(table.on_siblings)
    kept: list[int] = []
    for family in np.random.default_rng(SEED).permutation(np.unique(table.families)):
        rows = np.flatnonzero(table.families == family)
        if len(kept) + len(rows) <= MOST or not kept:
            kept += rows.tolist()
    return table.select(np.sort(np.array(kept[:MOST])))


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """One car: (tests,) squared errors by budget and predictor, and by budget what our calls come to.

    `calls` counts tests called safe, those of them that fail, tests called failing, those of them that do not, orders
    of drives, and those of them after which the interval of the number of failures holds it.
    """

    errors: Mapping[tuple[int, str], Array]
    calls: Mapping[int, Array]


def score(hidden: OutcomeTable, failed: Bools) -> Scored:
    """Score predictors of one car, whose outcomes are (tests,) `failed`, after every budget; `hidden` has siblings."""
    truth, before = failed.astype(np.float64), predict(hidden)
    predictors = {name: predictor(hidden) for name, predictor in PREDICTORS.items()}
    errors: dict[tuple[int, str], Array] = {}
    calls: dict[int, Array] = {}
    for budget in BUDGETS:
        for draw in range(DRAWS if budget else 1):
            order = np.random.default_rng([SEED, draw]).choice(len(truth), budget, replace=False)
            drives = [Drive(int(row), bool(failed[row]), drawn=True) for row in order]
            for name, predictor in predictors.items():
                predicted = np.array(predictor(drives))
                predicted[order] = truth[order]
                share = (predicted - truth) ** 2 / (DRAWS if budget else 1)
                errors[budget, name] = errors.get((budget, name), 0.0) + share
                if name == MODEL:
                    left = ~np.isin(np.arange(len(truth)), order)
                    safe, fails = predicted[left] <= ERROR_RATE, predicted[left] >= 1.0 - ERROR_RATE
                    wrong = failed[left]
                    _, low, high = before.updated(drives).failures(np.flatnonzero(left))
                    counts = [safe.sum(), (safe & wrong).sum(), fails.sum(), (fails & ~wrong).sum(), 1]
                    calls[budget] = calls.get(budget, np.zeros(6)) + [*counts, low <= wrong.sum() <= high]
    return Scored(errors=errors, calls=calls)


def made(hidden: OutcomeTable, failed: Bools, kind: str, rng: np.random.Generator) -> Bools:
    """Outcomes of a car of one of `KINDS`; the last two fail on at least a fifth of the tests."""
    if kind in ("as it is", "control"):
        return failed if kind == "as it is" else rng.permutation(failed)
    heard = np.mean([hidden.failed(name) for name in hidden.siblings], axis=0) + 1e-6 * rng.random(len(failed))
    if kind == "other":
        used = np.flatnonzero(hidden.features.std(axis=0) > 1e-12)
        alike = [abs(np.corrcoef(hidden.features[:, k], heard)[0, 1]) for k in used]
        heard = -hidden.features[:, used[int(np.argmin(alike))]]
    return np.asarray(np.argsort(np.argsort(heard)) < max(failed.sum(), len(failed) // 5))


def answers(prediction: Prediction, failed: Bools, seed: Sequence[int]) -> Iterator[tuple[int, str]]:
    """Budget, and what is said of the siblings after so many drawn drives."""
    order = np.random.default_rng(seed).permutation(len(failed))
    for budget in HELP_BUDGETS:
        if budget <= len(failed):
            drives = [Drive(int(row), bool(failed[row]), drawn=True) for row in order[:budget]]
            yield budget, sibling_help(prediction, prediction.updated(drives)).answer


def interval(parts: Sequence[tuple[Array, Indices]]) -> tuple[float, float, float]:
    """Mean over cars and tests, with its 95% interval over cars and families."""
    rng = np.random.default_rng(SEED)
    sums = [(np.bincount(families, values), np.bincount(families)) for values, families in parts]
    means = []
    for _ in range(RESAMPLES):
        cars = []
        for k in rng.integers(0, len(sums), len(sums)):
            total, count = sums[k]
            weights = rng.multinomial(len(total), np.full(len(total), 1.0 / len(total)))
            cars.append(float(weights @ total / max(weights @ count, 1)))
        means.append(np.mean(cars))
    low, high = np.quantile(means, (0.025, 0.975))
    return float(np.mean([values.mean() for values, _ in parts])), float(low), float(high)


def cars_of(folder: Path) -> Iterator[tuple[str, OutcomeTable, Bools]]:
    """Name, siblings' outcomes and own outcomes of every car of a table."""
    table, twin = sample(read_table(folder)), read_table(folder).twin
    for car in [twin] if twin and len(table.siblings) < 3 else table.siblings:
        yield car, table.with_twin(car).with_twin(None), table.failed(car)


def behind(cars: Sequence[Scored]) -> dict[int, float]:
    """By how much our mean Brier score lies behind the best simple one's, by budget."""

    def mean(budget: int, one: str) -> float:
        return float(np.mean([car.errors[budget, one].mean() for car in cars]))

    return {budget: mean(budget, MODEL) - min(mean(budget, one) for one in SIMPLE) for budget in BUDGETS}


def main() -> None:
    """Score all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--foreign", type=Path, help="folder of studies that are not shipped")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    studies = sorted(one.parent for one in OURS.glob("*/outcomes.parquet"))
    studies += sorted(one.parent for one in arguments.foreign.glob("*/outcomes.parquet")) if arguments.foreign else []
    rows: list[tuple[Value, ...]] = []
    calls: list[tuple[Value, ...]] = []
    said = Counter[tuple[str, str, int, str]]()
    for folder in studies:
        cars, families = [], []
        for car, hidden, failed in cars_of(folder):
            cars.append(score(hidden, failed))
            families.append(hidden.families)
            prediction = predict(hidden)
            for order in range(HELP_ORDERS):
                for k, kind in enumerate(KINDS):
                    outcomes = made(hidden, failed, kind, np.random.default_rng([SEED, order]))
                    for budget, answer in answers(prediction, outcomes, [SEED, order, k]):
                        said[folder.name, kind, budget, answer] += 1
            say(f"{folder.name}, {car}")
        for budget, name in cars[0].errors:
            parts = [(car.errors[budget, name], of) for car, of in zip(cars, families, strict=True)]
            rows.append((folder.name, len(families[0]), len(cars), budget, name, *interval(parts)))
        for budget in BUDGETS:
            calls.append((folder.name, budget, *map(int, np.sum([car.calls[budget] for car in cars], axis=0))))
        say(f"{folder.name}: {', '.join(f'{k}: {v:+.3f}' for k, v in behind(cars).items())} behind the best simple one")
    said_of_siblings = ("helped", "misled", "open")
    helped: list[tuple[Value, ...]] = [
        (*key, *(said[*key, answer] for answer in said_of_siblings)) for key in dict.fromkeys(one[:3] for one in said)
    ]
    called_as = ("called safe", "of them fail", "called failing", "of them do not fail", "intervals", "hold")
    scores = ("table", "tests", "cars", "drives", "predictor", "Brier", "low", "high")
    tables = [
        Table(name=name, title=name, columns=styled("text", *columns), rows=of)
        for name, columns, of in (
            ("predictors", scores, rows),
            ("predictor_calls", ("table", "drives", *called_as), calls),
            ("sibling_help", ("table", "car", "drives", *said_of_siblings), helped),
        )
    ]
    write_tables(tables, arguments.out)


if __name__ == "__main__":
    main()
