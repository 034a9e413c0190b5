# SPDX-License-Identifier: Apache-2.0
"""How often is a sentence of the product wrong under noise, and how often is it said under an effect?

`python -m benchmarks.claims --out docs/data` writes `claims.csv`, in some minutes on one core. Campaigns are searches
as the product runs them, with its own roads, conditions and families of mutants; outcomes are drawn. Every constant was
fixed before a result was seen. A claim is computed by the product's own functions.

Under *noise* nothing that is searched has to do with the outcomes; under *noise in families* mutants of a road mostly
end alike, for a reason that nothing searched knows. There, every statement is an error, which 5% may make.
"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.special import expit, logit

from ds_analysis.common.selection import ALPHA, most_frequent, p_of_leads
from ds_analysis.common.statistics import Array, Bools, Indices, families_of
from ds_analysis.comparison.analysis import compare_networks
from ds_analysis.comparison.paired_drives import ComparedTest, DriveOutcome, Network, PairedDrive
from ds_analysis.paper.correlation import evaluate, paired_differences
from ds_base.folder_files import write_whole
from ds_base.table import Table, Value, styled
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.maps.campaign_maps import build_maps
from ds_orchestrator.search.algorithms import ConditionSpace, DeepHyperion, SearchedCondition, SearchSettings
from ds_orchestrator.store.model import NO_DRIVE, Execution, Origin, Test
from ds_report.findings import RoadOutcomes, best_split, kind_of, side_shown
from ds_sim import BULLET, DONKEY, SOFTBODY, SimulatorName
from ds_sim.conditions.model import FIELDS
from ds_sim.simulator import Outcome

SIBLINGS, TWIN = (BULLET, SOFTBODY), DONKEY
SEARCHES = {8: (4, 0), 14: (3, 4), 24: (4, 8), 40: (8, 12), 120: (12, 48)}
"""Tests -> random roads and mutants of the search on each of two siblings; 8 are a first answer of
`ds test`, 24 and 120 its sizes."""
CONDITIONS = {
    "visibility": (20.0, 1000.0),
    "line_contrast": (0.1, 1.0),
    "line_cover": (0.0, 0.6),
    "illuminance": (10.0, 10_000.0),
    "veiling_luminance": (0.0, 3000.0),
    "lens_dirt": (0.0, 0.5),
    "sensor_noise": (0.0, 40.0),
    "steering_lag": (0.0, 0.6),
    "command_delay": (0.0, 0.6),
    "friction": (0.2, 1.0),
}
AXES = (2, 3, 12)
"""Axes that are searched: curvature and turns, with no, one or ten conditions."""
BANK = 40
"""Searches of each size and number of axes; outcomes are drawn for them again and again."""
CAMPAIGNS, NOISE_CAMPAIGNS = 300, 1000
NOISE, SPREAD = 0.3, 2.0
"""Failure probability under noise; standard deviation of the families' log odds where they end alike."""


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Failure probabilities below and above a threshold on one axis.

    Attributes:
        quantile: share of the tests below the threshold.
        spread: standard deviation of the families' log odds, besides.
    """

    name: str
    low: float
    high: float
    quantile: float = 0.5
    spread: float = 0.0


NOISES = (
    Effect(name="noise", low=NOISE, high=NOISE),
    Effect(name="noise in families", low=NOISE, high=NOISE, spread=SPREAD),
)
EFFECTS = (
    Effect(name="clear effect", low=0.05, high=0.9, quantile=0.6),
    Effect(name="clear effect, families", low=0.1, high=0.8, spread=1.0),
    Effect(name="weak effect", low=0.2, high=0.5),
)


@dataclass(frozen=True, kw_only=True)
class Searched:
    """Tests of one campaign.

    Attributes:
        tests: the tests.
        axes: (axes, tests) values, larger where a test is harder: curvature, turns, conditions as in `CONDITIONS`.
        families: (tests,) number of the family.
    """

    tests: tuple[Test, ...]
    axes: Array
    families: Indices


@cache
def bank(size: int, axes: int) -> tuple[Searched, ...]:
    """Search campaigns whose fitness is noise."""
    return tuple(_searched(size, axes, number) for number in range(BANK))


def _searched(size: int, axes: int, number: int) -> Searched:
    names = list(CONDITIONS)[: axes - 2]
    space = ConditionSpace([SearchedCondition(name=n, low=CONDITIONS[n][0], high=CONDITIONS[n][1]) for n in names])
    population, iterations = SEARCHES[size]
    settings = SearchSettings(population=population, iterations=iterations, min_angle=150, conditions=space)
    tests: list[Test] = []
    for k, sibling in enumerate(SIBLINGS):
        rng = np.random.default_rng([size, axes, number, k])
        search = DeepHyperion(settings, rng)
        while not search.done:
            scenario = search.ask_test(seed=1)
            tests.append(Test(f"{sibling}-0-{len(tests):04d}", scenario, Origin(sibling, 0, len(tests))))
            search.tell(float(rng.uniform(0.0, 2.0)))
    values = [[value_on(test, axis) for test in tests] for axis in ("curvature", "turns", *names)]
    return Searched(tests=tuple(tests), axes=np.array(values), families=families_of([test.road for test in tests]))


def value_on(test: Test, axis: str) -> float:
    """Value of a test on an axis of `ds_report.findings`, larger where it is harder."""
    if axis == "curvature":
        return test.road.curvature
    if axis == "turns":
        return float(test.road.turns_count)
    return float(getattr(test.conditions, axis)) * (-1.0 if FIELDS[axis].stronger == "low" else 1.0)


def campaigns(
    size: int, axes: int, effect: Effect, number: int
) -> Iterator[tuple[Searched, int, Bools, np.random.Generator]]:
    """Draw outcomes of campaigns under an effect on an axis; yields tests, axis, outcomes, and a generator."""
    searched, rng = bank(size, axes), np.random.default_rng([size, axes, sum(map(ord, effect.name))])
    thresholds = _thresholds(size, axes, effect)
    for k in range(number):
        one = searched[k % len(searched)]
        axis = int(rng.integers(axes))
        rate = np.where(one.axes[axis] > thresholds[axis], effect.high, effect.low)
        yield one, axis, drawn(rate, one.families, effect.spread, rng), rng


def _thresholds(size: int, axes: int, effect: Effect) -> Array:
    every = np.concatenate([one.axes for one in bank(size, axes)], axis=1)
    return np.asarray(np.quantile(every, effect.quantile, axis=1))


def drawn(rate: Array, families: Indices, spread: float, rng: np.random.Generator) -> Bools:
    """Draw outcomes; families share a random part of their log odds."""
    if spread:
        rate = expit(logit(rate) + spread * rng.standard_normal(families.max() + 1)[families])
    return rng.random(len(rate)) < rate


def outcomes_of(searched: Searched, failed: Bools) -> RoadOutcomes:
    """Outcomes as the report takes them."""
    return RoadOutcomes(where="the twin", tests=searched.tests, failed=tuple(failed.tolist()))


def splits(size: int, axes: int, effect: Effect, number: int = CAMPAIGNS) -> list[Value]:
    """Rate at which a split is stated, and its intervals' coverage."""
    stated, covered, thresholds = 0, np.zeros(2), _thresholds(size, axes, effect)
    odds = effect.spread * np.random.default_rng(1).standard_normal(2000)
    marginal = [float(expit(logit(rate) + odds).mean()) for rate in (effect.low, effect.high)]
    every = np.concatenate([one.axes for one in bank(size, axes)], axis=1)
    names = ["curvature", "turns", *CONDITIONS]
    for searched, axis, failed, _ in campaigns(size, axes, effect, number):
        split = best_split(outcomes_of(searched, failed))
        if split is None or not split.is_clear:
            continue
        stated += 1
        harder = every[names.index(split.axis)] >= split.threshold * (1.0 if split.is_lower_bound else -1.0)
        rate = np.where(every[axis] > thresholds[axis], marginal[1], marginal[0])
        for side, share in enumerate(split.apart or ()):
            low, high = share.interval
            covered[side] += low <= rate[harder == (side == 0)].mean() <= high
    shares = covered / stated if stated >= FEWEST_STATED else (None, None)
    return ["a split is stated", effect.name, size, axes, number, stated / number, *shares]


FEWEST_STATED = 20
"""Statements whose coverage is tabulated; chosen: fewer say nothing about 95%."""


def second_splits(size: int, axes: int, second: Effect, number: int = CAMPAIGNS) -> list[Value]:
    """Rate at which a condition is named after a clear effect of bends; the condition has such an effect, or none."""
    stated, (bend, _, condition) = 0, _thresholds(size, axes, EFFECTS[0])
    for searched, _, _, rng in campaigns(size, axes, second, number):
        above = searched.axes[2] > condition if second.high > second.low else np.zeros(size, np.bool_)
        hard = (searched.axes[0] > bend) | above
        rate = np.where(hard, EFFECTS[0].high, EFFECTS[0].low)
        outcomes = outcomes_of(searched, drawn(rate, searched.families, second.spread, rng))
        first = best_split(outcomes)
        if first is not None and first.is_clear:
            second_split = best_split(outcomes, "road" if kind_of(first.axis) == "conditions" else "conditions")
            stated += second_split is not None and second_split.is_clear
    return ["a second split is stated", second.name, size, axes, number, stated / number, None, None]


def beliefs(size: int, siblings: int, follows: float, number: int = CAMPAIGNS) -> list[Value]:
    """Rate at which a sibling is to be believed: the twin follows the first one so often, and otherwise a coin."""
    rng, stated = np.random.default_rng([size, siblings, int(10 * follows)]), 0
    for k in range(number):
        families = bank(size, 2)[k % BANK].families
        rate = np.full(len(families), NOISE)
        of_siblings = np.array([drawn(rate, families, SPREAD, rng) for _ in range(siblings)])
        coin = rng.random(families.max() + 1)[families] < 0.5
        twin = np.where(rng.random(len(families)) < follows, of_siblings[0], coin)
        split = of_siblings.any(axis=0) & ~of_siblings.all(axis=0)
        if not split.any():
            continue
        right = of_siblings[:, split] == twin[split]
        stated += bool((p_of_leads(np.where(right, 1.0, -1.0), families[split]) <= ALPHA).any())
    kind = "noise in families" if not follows else "clear effect"
    return [f"one of {siblings} siblings is to be believed", kind, size, None, number, stated / number, None, None]


def most_often(size: int, first: float, number: int = CAMPAIGNS) -> list[Value]:
    """Rate at which one of four ways of failing is said to lead; families mostly fail in one way."""
    rng, stated = np.random.default_rng([size, int(100 * first)]), 0
    share = np.array([first, *[(1.0 - first) / 3.0] * 3])
    for k in range(number):
        families = bank(size, 2)[k % BANK].families
        of_family = rng.choice(4, families.max() + 1, p=share)[families]
        kinds = np.where(rng.random(len(families)) < 0.7, of_family, rng.choice(4, len(families), p=share))
        stated += most_frequent([str(kind) for kind in kinds], families) is not None
    kind = "noise in families" if first == 0.25 else "clear effect"
    return ["a way of failing leads", kind, size, None, number, stated / number, None, None]


def _outcome(failed: bool) -> DriveOutcome:
    return DriveOutcome(outcome=Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED, fitness=None)


def verdicts(size: int, worse: float, number: int) -> list[list[Value]]:
    """Rates at which `ds compare` calls a network worse or better somewhere, and at which it names a kind of road."""
    rng, stated = np.random.default_rng([size, int(10 * worse)]), np.zeros(2)
    old, new = Network(driver=DriverName("old")), Network(driver=DriverName("new"))
    simulators = (*SIBLINGS, TWIN)
    bank(size, 2)
    gc.freeze()  # statsmodels collects garbage with each adjustment
    for k in range(number):
        searched, drives = bank(size, 2)[k % BANK], list[PairedDrive]()
        for name in simulators:
            # Both networks have the same rates, and families of their own on which they fail.
            reference = drawn(np.full(size, NOISE), searched.families, SPREAD, rng)
            candidate = drawn(np.full(size, NOISE + worse), searched.families, SPREAD, rng)
            for test, one, other in zip(searched.tests, reference, candidate, strict=True):
                cell = test.road.turns_count, int(100 * test.road.curvature)
                compared = ComparedTest(name=test.test_id, scenario=test.scenario, cell=cell)
                first, second = _outcome(one), _outcome(other)
                drives.append(PairedDrive(test=compared, simulator=name, reference=first, candidate=second))
        result = compare_networks(drives, reference=old, candidate=new, origin="both", source="", simulators=simulators)
        said = ("worse",) if worse else ("worse", "better")
        stated += any(row.verdict in said for row in result.simulators), min(c.p_adjusted for c in result.cells) < ALPHA
    kind = "clear effect" if worse else "noise in families"
    names = ["a network is worse or better"] if worse else ["a network is worse or better", "a kind of road stands out"]
    return [[name, kind, size, None, number, stated[k] / number, None, None] for k, name in enumerate(names)]


def merged_maps(size: int, noise: Effect, number: int = CAMPAIGNS) -> list[Value]:
    """Rate at which the merged map is called better or worse than a sibling, where no map knows the twin's failures."""
    rng, stated = np.random.default_rng([size, int(noise.spread)]), 0
    for k in range(number):
        searched, executions = bank(size, 2)[k % BANK], list[Execution]()
        for name in (*SIBLINGS, TWIN):
            failed = drawn(np.full(size, NOISE), searched.families, noise.spread, rng)
            executions += [_execution(test, name, lost, rng) for test, lost in zip(searched.tests, failed, strict=True)]
        maps = build_maps(SIBLINGS, TWIN, searched.tests, executions)
        allowed = {
            c.value
            for c in evaluate(maps, SIBLINGS, TWIN, resamples=0)
            if c.map.kind == "merged" and not c.caution and c.r is not None and c.r > 0.0
        }
        differences = paired_differences(maps, SIBLINGS, TWIN, resamples=400) if allowed else []
        shown = [one for one in differences if one.value in allowed]
        stated += any(side_shown(one, len(differences)) for one in shown)
    claim = "the merged map is better or worse than a sibling"
    return [claim, noise.name, size, None, number, stated / number, None, None]


def _execution(test: Test, name: SimulatorName, failed: bool, rng: np.random.Generator) -> Execution:
    lateral = float(rng.uniform(2.0, 3.0) if failed else rng.uniform(0.2, 2.0))
    return Execution(
        test_id=test.test_id,
        simulator=name,
        outcome=Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED,
        message="",
        fitness=2.0 - lateral,
        max_lateral_position=lateral,
        steps=1,
        simulated_seconds=0.05,
        trajectory_sha256="",
        drive=NO_DRIVE,
    )


def rows_of_claims() -> Iterator[Sequence[Value]]:
    """Every row of the table, with the share of campaigns in which a claim is made."""
    for size in SEARCHES:
        for axes in AXES:
            yield from (splits(size, axes, noise, NOISE_CAMPAIGNS) for noise in NOISES)
            yield from (splits(size, axes, effect) for effect in EFFECTS)
    for size in (40, 120):
        yield from (second_splits(size, 3, noise, NOISE_CAMPAIGNS) for noise in NOISES)
        yield second_splits(size, 3, EFFECTS[0])
    for size in (8, 24, 40, 120):
        yield from (beliefs(size, siblings, follows) for siblings in (2, 4) for follows in (0.0, 0.9))
        yield from (most_often(size, first) for first in (0.25, 0.7))
        yield from (row for worse in (0.0, 0.5) for row in verdicts(size, worse, CAMPAIGNS // 4))
    yield from (merged_maps(120, noise) for noise in NOISES)


def main() -> None:
    """Compute the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of claims.csv")
    columns = [*styled("text", "claim", "situation"), *styled("count", "tests", "axes", "campaigns")]
    columns += styled("number", "stated", "covered, harder side", "covered, other side")
    rows, out = [], parser.parse_args().out
    for row in rows_of_claims():
        print(*("" if value is None else value for value in row), sep=", ", flush=True)
        rows.append(row)
    table = Table(name="claims", title="Error rate and power of every claim", columns=columns, rows=rows)
    write_whole(out / "claims.csv", table.csv())


if __name__ == "__main__":
    main()
