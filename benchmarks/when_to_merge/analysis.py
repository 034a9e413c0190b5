# SPDX-License-Identifier: Apache-2.0
"""Computes every number of the study of when two siblings are better than one; see `PLAN.md`.

`python -m benchmarks.when_to_merge.analysis`: a part of the study is shown once all of its drives are there. `--final`
ends the study with the networks that are whole. `--made-up SEED` runs the same code on outcomes that a simple model
makes, and counts its decisions.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
from benchmarks.replication.drive import TABLES as CAMPAIGN_TABLES
from benchmarks.when_to_merge import plan
from benchmarks.when_to_merge.plan import CAMPAIGN, PARTS, SIBLINGS, TWINS
from numpy.typing import NDArray
from scipy import stats

from ds_analysis.common.outcome_table import ROAD_FEATURES
from ds_analysis.common.statistics import auc_prc_or_nan, families_of
from ds_road import road_from_json
from ds_sim.conditions.text import parse_conditions

Array = NDArray[np.float64]
Key = tuple[str, tuple[str, str]]
"""Twin and two siblings."""
USUAL, TWO_MAKERS = ("bullet", "softbody"), (("panda", "torcs"), ("softbody", "torcs"))
FOUR = (*SIBLINGS, "nominal")
KEYS_A: list[Key] = [(twin, pair) for twin in TWINS for pair in combinations(SIBLINGS, 2)]
KEYS_B: list[Key] = [(twin, pair) for twin in TWINS for pair in (USUAL, *TWO_MAKERS)]
KEYS_C: list[Key] = [(twin, pair) for twin in FOUR for pair in combinations([one for one in FOUR if one != twin], 2)]


class Known(NamedTuple):
    """What is known of tests before a drive: numbers of their cells and families, and (tests, features)."""

    cells: NDArray[np.intp]
    families: NDArray[np.intp]
    features: Array


class Block(NamedTuple):
    """What a network did: simulator -> (tests,) 1 if it failed, 0 if it passed, NaN without a verdict."""

    known: Known
    failed: Mapping[str, Array]


class Case(NamedTuple):
    """A network, a twin and two siblings: what their product gains in r and AUC-PRC, as it is and in resamples."""

    network: str
    twin: str
    pair: tuple[str, str]
    both_harder: bool
    gain: Array
    gain_auc: Array
    r: Mapping[str, float]
    failed: Array


class Estimate(NamedTuple):
    """A mean over networks, with Student's 95 % interval over networks, and one of resampled families if it has one."""

    mean: float
    networks: int
    intervals: tuple[tuple[float, float], ...]

    @property
    def decision(self) -> str:
        """What the plan says of it."""
        lows, highs = zip(*self.intervals, strict=True)
        if self.networks < plan.FEWEST_NETWORKS:
            return "undecided, too few networks"
        return "above 0" if min(lows) > 0 else "below 0" if max(highs) < 0 else "undecided"

    def __str__(self) -> str:
        intervals = "; families ".join(f"{low:+.3f} to {high:+.3f}" for low, high in self.intervals)
        return f"{self.mean:+.3f} ({intervals}; {self.networks} networks): {self.decision}"


def known_of(rows: Sequence[Mapping[str, Any]]) -> Known:
    """Cells, families and features of tests."""
    roads = [road_from_json(json.loads(row["road"])) for row in rows]
    features = np.array([[of(road) for of in ROAD_FEATURES.values()] for road in roads])
    if any("line_contrast" in row["conditions"] for row in rows):
        conditions = [parse_conditions(row["conditions"]) for row in rows]
        features = np.column_stack([features, [(one.line_contrast, one.visibility) for one in conditions]])
    return Known(np.unique([row["cell"] for row in rows], axis=0, return_inverse=True)[1], families_of(roads), features)


def load(network: str, mild: bool, tables: Path) -> Block:
    """Read what a network did: in this study, and in the campaign's first run but for the twin."""
    files = []
    if network in CAMPAIGN and not mild:
        files = [(CAMPAIGN_TABLES / f"{network}.parquet", dict(zip(USUAL, USUAL, strict=True)))]
        if network in plan.TORCS_NETWORKS:
            files.append((CAMPAIGN_TABLES / f"{network}_panda.parquet", {"panda": "panda"}))
    for part in (part for part in PARTS if part.network == network and (part.block == "C") == mild):
        if (tables / f"{part.name}.parquet").exists():
            files.append((tables / f"{part.name}.parquet", {plan.SIMULATORS.get(part.where, part.where): part.where}))
    tests: dict[str, dict[str, Any]] = {}
    found: dict[str, dict[str, float]] = {}
    for file, names in files:
        for row in pq.read_table(file, filters=[("run", "==", 0)]).to_pylist():
            tests.setdefault(row["test_id"], row)
            if row["simulator"] in names and row["failed"] is not None:
                found.setdefault(names[row["simulator"]], {})[row["test_id"]] = float(row["failed"])
    drawn = plan.drawn({test: row["sibling"] for test, row in tests.items()})
    tests = {test: row for test, row in tests.items() if test in drawn}
    failed = {name: np.array([of.get(test, np.nan) for test in tests]) for name, of in found.items()}
    return Block(known_of(list(tests.values())), failed)


def r_of(predicted: Array, truth: Array, filled: NDArray[np.bool_]) -> Array:
    """(resamples,) Pearson's r over filled cells: 0 for a map without differences, NaN if the twin's has none."""
    n = filled.sum(axis=1, keepdims=True)
    x, y = (np.where(filled, one - (one * filled).sum(axis=1, keepdims=True) / n, 0.0) for one in (predicted, truth))
    xx, yy = (x * x).sum(axis=1), (y * y).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        r = np.where(xx < 1e-12, 0.0, (x * y).sum(axis=1) / np.sqrt(xx * yy))
    return np.where((yy < 1e-12) | (n[:, 0] < 3), np.nan, r)


def case_of(network: str, block: Block, key: Key, weights: Array, with_auc: bool) -> Case | None:
    """Compare the maps of two siblings and of their product with the twin's; None if one of the three hardly fails."""
    twin, pair = key
    three = np.array([block.failed[name] for name in (*pair, twin)])
    judged = np.isfinite(three).all(axis=0)
    failed, weights = three[:, judged], weights[:, judged]
    if min(failed.sum(axis=1).min(), (1 - failed).sum(axis=1).min()) < plan.FEWEST:
        return None
    member = np.eye(block.known.cells.max() + 1)[block.known.cells[judged]]
    tests = weights @ member
    filled = tests > 0
    one, other, truth = (np.where(filled, (weights * of) @ member / np.maximum(tests, 1), 0.0) for of in failed)
    maps = {"first": one, "second": other, "product": one * other, "mean": (one + other) / 2}
    r = {name: r_of(of, truth, filled) for name, of in maps.items()}
    auc = {name: np.full(len(weights), np.nan) for name in maps}
    for name in ("first", "second", "product") if with_auc else ():
        auc[name] = np.array([auc_prc_or_nan(p[f], t[f]) for p, t, f in zip(maps[name], truth, filled, strict=True)])
    gain, gain_auc = (of["product"] - np.maximum(of["first"], of["second"]) for of in (r, auc))
    both_harder = bool(failed[:2].mean(axis=1).min() > failed[2].mean())
    return Case(
        network, twin, pair, both_harder, gain, gain_auc, {name: float(of[0]) for name, of in r.items()}, failed
    )


def cases_of(blocks: Mapping[str, Block], keys: Sequence[Key], resamples: int, with_auc: bool = False) -> list[Case]:
    """Every case that enters; a network's cases share resamples of whole families, the first of which is none."""
    found = []
    for name, block in blocks.items():
        number = int(block.known.families.max()) + 1
        rng = np.random.default_rng([plan.SEED, *name.encode()])
        drawn = rng.multinomial(number, np.full(number, 1 / number), resamples)[:, block.known.families]
        weights = np.vstack([np.ones(len(block.known.cells)), drawn])
        found += [case_of(name, block, key, weights, with_auc) for key in keys]
    return [case for case in found if case is not None and np.isfinite(case.gain[0])]


def estimate(each: Sequence[Array]) -> Estimate:
    """Estimate the mean over networks from (1 + resamples,) values of each."""
    values = np.array([one for one in each if np.isfinite(one[0])])
    if len(values) < 2:
        return Estimate(float(values[0, 0]) if len(values) else np.nan, len(values), ((np.nan, np.nan),))
    now = values[:, 0]
    half = float(stats.t.ppf(0.975, len(now) - 1) * now.std(ddof=1) / len(now) ** 0.5)
    intervals = [(float(now.mean()) - half, float(now.mean()) + half)]
    if values.shape[1] > 1:
        low, high = np.nanquantile(np.nanmean(values, axis=0)[1:], [0.025, 0.975])
        intervals.append((float(low), float(high)))
    return Estimate(float(now.mean()), len(now), tuple(intervals))


def contrast(cases: Sequence[Case], value: str = "gain") -> Estimate:
    """Gain where both siblings fail more often than the twin minus gain elsewhere, within networks."""
    found = []
    for network in dict.fromkeys(case.network for case in cases):
        of = [case for case in cases if case.network == network and np.isfinite(getattr(case, value)[0])]
        harder, others = ([getattr(case, value) for case in of if case.both_harder == kind] for kind in (True, False))
        if harder and others:
            found.append(np.nanmean(harder, axis=0) - np.nanmean(others, axis=0))
    return estimate(found)


def choose(case: Case, rng: np.random.Generator) -> Mapping[str, float]:
    """Mean r of the operator that the rule chooses by ten drives on the twin, minus that of each alternative."""
    drawn = case.failed[:, [rng.choice(case.failed.shape[1], plan.DRIVES, replace=False) for _ in range(plan.DRAWS)]]
    on_twin, (one, other, _) = drawn[2].mean(axis=1), case.failed.mean(axis=1)
    # Verdicts that differ from the twin's; of equal ones, the sibling whose share of failures is nearer to it.
    wrong = [
        (of != drawn[2]).sum(axis=1) + abs(share - on_twin) / 2 for of, share in ((drawn[0], one), (drawn[1], other))
    ]
    rule = np.where(min(one, other) > on_twin, case.r["product"], case.r["mean"]).mean()
    better = np.where(wrong[0] <= wrong[1], case.r["first"], case.r["second"]).mean()
    return {"product": rule - case.r["product"], "mean": rule - case.r["mean"], "better sibling": rule - better}


def choices(cases: Sequence[Case]) -> Mapping[str, Estimate]:
    """What the rule's choice gains over each alternative."""
    rng = np.random.default_rng(plan.SEED)
    found: dict[str, dict[str, list[float]]] = {}
    for case in cases:
        for alternative, value in choose(case, rng).items():
            found.setdefault(alternative, {}).setdefault(case.network, []).append(value)
    return {name: estimate([np.array([np.mean(one)]) for one in of.values()]) for name, of in found.items()}


def of_two_makers(cases: Sequence[Case]) -> Iterator[str]:
    """Gain of each planned pair minus that of bullet and softbody, over twins to which both have the same relation."""
    by_key = {case[:3]: case for case in cases}
    for pair in TWO_MAKERS:
        both = [(case, by_key.get((case.network, case.twin, USUAL))) for case in cases if case.pair == pair]
        found = [one.gain - usual.gain for one, usual in both if usual and one.both_harder == usual.both_harder]
        if found:
            low, high = np.nanquantile(np.nanmean(found, axis=0)[1:], [0.025, 0.975])
            what = f"{' and '.join(pair)} minus {' and '.join(USUAL)}, {len(found)} cases of equal difficulty"
            yield f"B: {what}: {np.mean(found, axis=0)[0]:+.3f} (families {low:+.3f} to {high:+.3f})"


def nesting(block: Block) -> float:
    """Mean of Loevinger's H over pairs of simulators: 1 if failures are nested, 0 if they are independent."""
    found = []
    for pair in combinations([block.failed[name] for name in FOUR], 2):
        rare, often = sorted(np.array(pair)[:, np.isfinite(pair).all(axis=0)], key=np.sum)
        if min(rare.sum(), (1 - often).sum()) >= plan.FEWEST:
            found.append(1 - (rare * (1 - often)).sum() / (rare.sum() * (1 - often).mean()))
    return float(np.mean(found)) if found else np.nan


def explained(block: Block) -> float:
    """Share that the best single axis explains: |2 AUC-ROC - 1| of the best feature, mean over simulators."""
    found = []
    for values in (block.failed[name] for name in FOUR):
        failed = values[np.isfinite(values)] > 0
        if min(n := failed.sum(), m := (~failed).sum()) >= plan.FEWEST:
            ranks = stats.rankdata(block.known.features[np.isfinite(values)], axis=0)[failed].sum(axis=0)
            found.append(np.abs(2 * (ranks - n * (n + 1) / 2) / (n * m) - 1).max())
    return float(np.mean(found)) if found else np.nan


def changes(plain: Mapping[str, Block], mild: Mapping[str, Block]) -> Iterator[str]:
    """What the mild conditions change, network by network."""

    def paying(blocks: Mapping[str, Block]) -> list[float]:
        gains = [[case.gain[0] > 0 for case in cases_of({name: of}, KEYS_C, 0)] for name, of in blocks.items()]
        return [float(np.mean(of)) if of else np.nan for of in gains]

    found = {
        "best single axis": [(explained(mild[name]), explained(plain[name])) for name in mild],
        "nesting": [(nesting(mild[name]), nesting(plain[name])) for name in mild],
        "share of cases in which merging pays": list(zip(paying(mild), paying(plain), strict=True)),
    }
    for what, values in found.items():
        yield f"C: {what}, mild minus plain: {estimate([np.array([one - other]) for one, other in values])}"


def show(what: str, blocks: Mapping[str, Block], keys: Sequence[Key], out: Path) -> None:
    """Print the three endpoints, and write a row for each case."""
    cases = cases_of(blocks, keys, plan.RESAMPLES, with_auc=True)
    print(f"{what}: {len(cases)} cases, in {sum(case.both_harder for case in cases)} both siblings fail more often")
    print(f"1. r: {contrast(cases)}\n2. AUC-PRC: {contrast(cases, 'gain_auc')}")
    for alternative, one in choices(cases).items():
        print(f"3. the rule's choice minus {alternative}: {one}")
    with out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        names = "network twin siblings both_harder failed_first failed_second failed_twin tests r_first r_second"
        writer.writerow([*names.split(), "r_product", "r_mean", "gain", "low", "high", "gain_auc"])
        for case in cases:
            numbers = *case.r.values(), case.gain[0], *np.nanquantile(case.gain[1:], [0.025, 0.975]), case.gain_auc[0]
            row = [case.network, case.twin, "+".join(case.pair), case.both_harder, *case.failed.sum(axis=1).astype(int)]
            writer.writerow([*row, case.failed.shape[1], *(f"{number:.3f}" for number in numbers)])


def made_up(known: Mapping[str, Known], strength: float, rng: np.random.Generator) -> dict[str, Block]:
    """Make outcomes: what the road and its family do to all simulators, and their own noise, beyond a threshold.

    With strength 0 the twin has nothing in common with the siblings, so that no contrast exists.
    """
    blocks = {}
    for name, of in known.items():
        common, own = (rng.normal(size=of.families.max() + 1)[of.families] for _ in range(2))
        road, noise = stats.zscore(of.features[:, 4]) + 0.5 * common, rng.uniform(0.2, 0.8)
        levels = rng.normal(-0.9, 0.4, 4)
        draw = [noise * rng.normal(size=len(road)) for _ in range(5)]
        failed = {one: road + draw[k] + levels[k] > 0 for k, one in enumerate(SIBLINGS)}
        latent = strength * (road + draw[3]) + (1 - strength) * (own + 3 * draw[4])
        for twin, shift in zip(TWINS, (0.0, -0.6, 0.6, 0.4), strict=True):
            failed[twin] = latent + levels[3] + shift + 0.2 * rng.normal(size=len(road)) > 0
        blocks[name] = Block(of, {one: values.astype(np.float64) for one, values in failed.items()})
    return blocks


def try_out(seed: int, repetitions: int) -> None:
    """Run part A's analysis on made-up outcomes of the campaign's roads, and count its decisions."""
    rows = {name: pq.read_table(CAMPAIGN_TABLES / f"{name}.parquet").to_pylist() for name in CAMPAIGN}
    runs = [{row["test_id"]: row for row in rows[name] if row["run"] == run} for run in (0, 1) for name in rows]
    drawn = [plan.drawn({test: row["sibling"] for test, row in run.items()}) for run in runs]
    used = [[row for test, row in run.items() if test in of] for run, of in zip(runs, drawn, strict=True)]
    known = {name: known_of(run) for name, run in zip(plan.DRIVERS, used, strict=False)}
    rng = np.random.default_rng(seed)
    for strength in (0.0, 0.5, 1.0):
        cases = [cases_of(made_up(known, strength, rng), KEYS_A, 200) for _ in range(repetitions)]
        found, third = [contrast(of) for of in cases], [{one.decision for one in choices(of).values()} for of in cases]
        made = {what: sum(one.decision == what for one in found) for what in ("above 0", "below 0", "undecided")}
        print(
            f"strength {strength}: contrast {np.mean([one.mean for one in found]):+.3f}, {made} of {repetitions}, "
            f"third endpoint met {third.count({'above 0'})} times"
        )
    power = stats.nct.sf(stats.t.ppf(0.975, 9), 9, 10**0.5)
    print(f"power of ten networks for a contrast of 0.10 whose standard deviation over networks is 0.10: {power:.2f}")


def main() -> None:
    """Show what is whole."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", type=Path, default=plan.TABLES)
    parser.add_argument("--out", type=Path, default=Path("docs/data"), help="for a row per case")
    parser.add_argument("--final", action="store_true", help="end the study with the networks that are whole")
    parser.add_argument("--made-up", type=int, metavar="SEED")
    parser.add_argument("--repetitions", type=int, default=30)
    arguments = parser.parse_args()
    if arguments.made_up is not None:
        return try_out(arguments.made_up, arguments.repetitions)
    missing = [part for part in PARTS if not (arguments.tables / f"{part.name}.parquet").exists()]
    whole: dict[str, set[str]] = {}
    for block in "ABC":
        lacking = [part for part in missing if part.block == block]
        print(f"{block}: {len(lacking)} parts are missing")
        networks = {part.network for part in PARTS if part.block == block} - {part.network for part in lacking}
        whole[block] = networks if arguments.final or not lacking else set()
    plain = {name: load(name, False, arguments.tables) for name in plan.DRIVERS if name in whole["A"]}
    mild = {name: load(name, True, arguments.tables) for name in plain if name in whole["C"]}
    if plain:
        show("A", plain, KEYS_A, arguments.out / "when_to_merge_plain.csv")
    if torcs := {name: of for name, of in plain.items() if name in whole["B"]}:
        print(*of_two_makers(cases_of(torcs, KEYS_B, plan.RESAMPLES)), sep="\n")
    if mild:
        show("C", mild, KEYS_C, arguments.out / "when_to_merge_mild.csv")
        print(*changes({name: plain[name] for name in mild}, mild), sep="\n")


if __name__ == "__main__":
    main()
