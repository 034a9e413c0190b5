"""Scores predictors of a car that was driven a few times, on tables of outcomes of ours and of others.

    python -m benchmarks.predictors --foreign FOLDER --out scores         # FOLDER with studies of `ds outcomes import`
    python -m benchmarks.predictors --predictor my_module:MyPredictor --out scores

Each simulator of a table is the car in turn, predicted from the others. A predictor has two methods:

- `fit(siblings)`: an `OutcomeTable` without the car's outcomes; called once for each car.
- `predict(drives)`: (tests,) probabilities of failure, of all tests, given the car's drives so far, `MarginDrive`s. The
  outcomes of driven tests are filled in for every predictor.

Drives are proposed as `ds real propose` does, or drawn at random (mean of `DRAWS` orders). Scores are Brier scores over
all tests. `benchmarks/prediction/foreign` says what the columns of two of others' tables are. *Controls* are the same
tables with the car's outcomes moved to other tests: siblings that say nothing about it. Intervals are 95 % over cars
and families, resampled together. Fixed before the tables were scored: tables, budgets, rules, predictors.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Protocol

import numpy as np
from benchmarks.prediction.budget_scores import RATE, SHIFTED, learned
from scipy.special import expit, logit

from ds_analysis.common.outcome_table import OutcomeTable
from ds_analysis.common.statistics import Array, Indices
from ds_analysis.common.table import Column, Table, write_tables
from ds_analysis.outcomes.folders import read_table
from ds_analysis.prediction.predictors import UNDRIVEN, merged, undriven_probabilities
from ds_analysis.prediction.real.drive_choice import choose
from ds_analysis.prediction.twin_prediction import MarginDrive, outcomes_of, predict_twin
from ds_cli.output import say

OURS = Path("docs/data/outcomes")
BUDGETS, DRAWS, CONTROLS = (0, 4, 8), 6, 3
MOST = 300
"""Tests of a table at most, whole families at random."""
SEED = 37
RESAMPLES = 2000
MODEL = "ours"
BASELINES = (UNDRIVEN, SHIFTED, RATE, "mean of the siblings")
"""What a prediction must not be worse than."""


class Predictor(Protocol):
    """What is scored; see the module."""

    def fit(self, siblings: OutcomeTable) -> None:
        """Learn from the siblings."""

    def predict(self, drives: Sequence[MarginDrive]) -> Array:
        """Predict all tests."""
        ...


class Ours:
    """`ds predict`."""

    def fit(self, siblings: OutcomeTable) -> None:
        """See `Predictor`."""
        self.before = predict_twin(siblings)

    def predict(self, drives: Sequence[MarginDrive]) -> Array:
        """See `Predictor`."""
        return self.before.updated(drives).probabilities()


class VerdictsOnly(Ours):
    """`ds predict`, which sees of each drive only whether it failed."""

    def predict(self, drives: Sequence[MarginDrive]) -> Array:
        """See `Predictor`."""
        return super().predict([replace(one, margin=None) for one in drives])


class Fixed:
    """A merge operator on the siblings' verdicts, or undriven features; drives do not change it."""

    def __init__(self, name: str) -> None:
        self.name = name

    def fit(self, siblings: OutcomeTable) -> None:
        """See `Predictor`."""
        failed = [siblings.failed(name).astype(np.float64) for name in siblings.siblings]
        operator = {"mean of the siblings": "mean", "product": "product"}.get(self.name, "")
        self.found = merged(failed)[operator] if operator else undriven_probabilities(siblings, "all")

    def predict(self, drives: Sequence[MarginDrive]) -> Array:
        """See `Predictor`."""
        return self.found.copy()


class Learned(Fixed):
    """The drives' failure rate (Jeffreys), or undriven features shifted by the drives."""

    def fit(self, siblings: OutcomeTable) -> None:
        """See `Predictor`."""
        self.found = undriven_probabilities(siblings, "all")

    def predict(self, drives: Sequence[MarginDrive]) -> Array:
        """See `Predictor`."""
        if not drives:
            return self.found.copy() if self.name == SHIFTED else np.full(len(self.found), 0.5)
        truth = np.zeros(len(self.found))
        truth[[one.row for one in drives]] = [one.failed for one in drives]
        return np.array(learned(self.found, truth, [one.row for one in drives])[self.name])


class Agreement(Fixed):
    """MultiSim's rule: a test fails where most siblings say so, with the drives' share of such calls that are right."""

    def fit(self, siblings: OutcomeTable) -> None:
        """See `Predictor`."""
        self.says = np.mean([siblings.failed(name) for name in siblings.siblings], axis=0) > 0.5
        self.found = np.where(self.says, 0.9, 0.1)

    def predict(self, drives: Sequence[MarginDrive]) -> Array:
        """See `Predictor`."""
        right = sum(bool(self.says[one.row]) == one.failed for one in drives)
        share = (right + 1.8) / (len(drives) + 2.0)  # as much as two drives, 0.9 of them right
        return np.where(self.says, share, 1.0 - share)


class ControlVariate(Fixed):
    """The mean of the siblings, moved by the drives' mean deviation from it, as X4Val and Sim2Val correct a mean."""

    def predict(self, drives: Sequence[MarginDrive]) -> Array:
        """See `Predictor`."""
        logits = logit(np.clip(self.found, 0.05, 0.95))
        off = sum(float(one.failed) - self.found[one.row] for one in drives) / max(len(drives), 1)
        return np.asarray(expit(logits + 4.0 * off))


def predictors() -> dict[str, Predictor]:
    """Make all of them; a name stands in the tables."""
    return {
        MODEL: Ours(),
        "ours, verdicts only": VerdictsOnly(),
        UNDRIVEN: Fixed(UNDRIVEN),
        SHIFTED: Learned(SHIFTED),
        RATE: Learned(RATE),
        "mean of the siblings": Fixed("mean of the siblings"),
        "product": Fixed("product"),
        "agreement": Agreement("agreement"),
        "control variate": ControlVariate("mean of the siblings"),
    }


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


def control(table: OutcomeTable, car: str, seed: int) -> OutcomeTable:
    """Move a car's outcomes to other tests."""
    order = np.random.default_rng([SEED, seed]).permutation(len(table))
    column = table.column(car)
    states, lateral = table.states.copy(), table.lateral.copy()
    states[:, column], lateral[:, column] = states[order, column], lateral[order, column]
    return replace(table, states=states, lateral=lateral)


Errors = dict[tuple[str, int, str], Array]
"""Rule, budget and predictor -> (tests,) squared errors."""


def errors_of(table: OutcomeTable, car: str, scored: Mapping[str, Predictor]) -> Errors:
    """Score predictors of one car after every budget, by both rules."""
    table = table.with_twin(car)
    truth = table.failed(car).astype(np.float64)
    drives = {one.row: one for one in outcomes_of(table, car)}
    hidden = table.with_twin(None)
    for predictor in scored.values():
        predictor.fit(hidden)
    ours = predict_twin(hidden)
    found: Errors = {}
    for rule in ("proposed", "random"):
        for budget in BUDGETS:
            orders: list[Indices] = []
            for draw in range(1 if rule == "proposed" or not budget else DRAWS):
                if rule == "proposed":
                    orders.append(np.array([one.row for one in choose(table, ours, budget)], np.intp))
                else:
                    orders.append(np.random.default_rng([SEED, draw]).choice(len(table), budget, replace=False))
            for name, predictor in scored.items():
                of = []
                for order in orders:
                    predicted = np.array(predictor.predict([drives[int(row)] for row in order]))
                    predicted[order] = truth[order]
                    of.append((predicted - truth) ** 2)
                found[rule, budget, name] = np.mean(of, axis=0)
    return found


def interval(parts: Sequence[tuple[Array, Indices]]) -> tuple[float, float, float]:
    """Mean over cars and tests, with its 95 % interval over cars and families."""
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


def main() -> None:
    """Score all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--foreign", type=Path, help="folder of studies that are not shipped")
    parser.add_argument("--predictor", help="module:Class beside the built-in ones")
    parser.add_argument("--tables", default="", help="only tables whose name has this in it")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    scored = predictors()
    if arguments.predictor:
        module, _, name = arguments.predictor.partition(":")
        scored[name] = getattr(import_module(module), name)()
    studies = sorted(one.parent for one in OURS.glob("*/outcomes.parquet"))
    studies += sorted(one.parent for one in arguments.foreign.glob("*/outcomes.parquet")) if arguments.foreign else []
    rows = []
    for folder in (one for one in studies if arguments.tables in one.name):
        table = sample(read_table(folder))
        twin = read_table(folder).twin
        cars = [twin] if twin and len(table.siblings) < 3 else list(table.siblings)
        for kind in ("", ", control"):
            parts: dict[tuple[str, int, str], list[tuple[Array, Indices]]] = {}
            for car in cars:
                for seed in range(CONTROLS) if kind else (0,):
                    made = control(table, car, seed) if kind else table
                    for key, errors in errors_of(made, car, scored).items():
                        parts.setdefault(key, []).append((errors, made.families))
            for (rule, budget, name), of in parts.items():
                rows.append((f"{folder.name}{kind}", len(table), len(of), rule, budget, name, *interval(of)))
            best = {
                (rule, budget): min(np.mean([v.mean() for v, _ in parts[rule, budget, n]]) for n in BASELINES)
                for rule, budget, _ in parts
            }
            behind = ", ".join(
                f"{rule} {budget}: {np.mean([v.mean() for v, _ in parts[rule, budget, MODEL]]) - least:+.3f}"
                for (rule, budget), least in best.items()
            )
            say(f"{folder.name}{kind}: {len(table)} tests, {len(cars)} cars; ours minus the best baseline: {behind}")
    columns = ["table", "tests", "cars", "drives", "budget", "predictor", "Brier", "low", "high"]
    scores = Table(name="predictors", title="Brier scores", columns=[Column(one) for one in columns], rows=rows)
    write_tables([scores], arguments.out)


if __name__ == "__main__":
    main()
