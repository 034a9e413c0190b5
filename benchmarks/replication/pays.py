# SPDX-License-Identifier: Apache-2.0
"""Where a product of failure probabilities beats the better sibling: 54 cases of the stored campaigns, without driving.

`python -m benchmarks.replication.pays` writes `docs/data/when_product_pays.csv` and prints the page's table. A case
takes one simulator as the twin and two of the others as siblings: three cases of each network's five runs, twelve of
each first run with a third sibling. Intervals resample whole families of mutants, and choose the better sibling anew.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from benchmarks.replication.drive import NETWORKS, TABLES, title_of
from benchmarks.replication.stored import read
from benchmarks.replication.tables import THIRD, third_table

from ds_analysis.common.statistics import Array, families_of
from ds_analysis.paper.merge_case import Advice, merge_case

RESAMPLES = 10_000
"""Chosen: with 1,000 the number of intervals that exclude 0 depends on the seed."""
EXACT = 1e-9  # an end of an interval that is nearer to 0 is 0
OPERATORS = ("product", "mean", "hardest sibling")
BY_RATES: tuple[Advice, ...] = ("hardest sibling", "mean", "product")
"""Case by the number of siblings that fail more often than the twin."""


@dataclass(frozen=True)
class Case:
    """One simulator as the twin, two others as siblings.

    Attributes:
        key: network, twin, siblings.
        rates: failure rates of the siblings and the twin.
        case: by these rates.
        stated: what `ds evaluate` says of the same tests.
        better: r of the better sibling with the twin.
        gains: operator -> its r minus the better sibling's, and the 95% interval.
    """

    key: tuple[str, str, str, str]
    rates: tuple[float, ...]
    case: Advice
    stated: Advice
    better: float
    gains: dict[str, tuple[float, ...]]


def cases_of(table: Path) -> Iterator[Case]:
    """Every case of a stored campaign."""
    data = read(table)
    failed = data.failed
    verdicts = {s: np.array([failed[test.test_id, s] for test in data.tests]) for s in data.config.simulators}
    families = families_of([test.road for test in data.tests])
    names = sorted(set(data.cells.values()))
    cells = np.array([names.index(data.cells[test.test_id]) for test in data.tests])
    place = families * len(names) + cells
    many = int(families.max()) + 1
    drawn = np.random.default_rng(0).multinomial(many, np.full(many, 1 / many), RESAMPLES)
    drawn = np.vstack([np.ones(many), drawn])

    def resampled(of_tests: Array | None) -> Array:
        counts = np.bincount(place, of_tests, many * len(names))
        return np.asarray(drawn @ counts.reshape(-1, len(names)))

    tests = resampled(None)
    filled = (tests > 0).astype(np.float64)
    maps = {s: resampled(values.astype(np.float64)) / np.maximum(tests, 1) for s, values in verdicts.items()}
    kept = np.isin([test.test_id for test in data.tests], [test.test_id for test in data.distinct.tests])
    for twin in verdicts:
        for pair in combinations([s for s in verdicts if s != twin], 2):
            easy, hard = sorted(pair, key=lambda s: int(verdicts[s].sum()))
            merged = {"product": maps[easy] * maps[hard], "mean": (maps[easy] + maps[hard]) / 2}
            merged["hardest sibling"] = maps[hard]
            better = np.fmax(*(_r(maps[s], maps[twin], filled) for s in pair))
            gains = {}
            for operator, values in merged.items():
                gain = _r(values, maps[twin], filled) - better
                gains[operator] = float(gain[0]), *map(float, np.nanquantile(gain[1:], [0.025, 0.975]))
            rates = tuple(float(verdicts[s].mean()) for s in (*pair, twin))
            stated = merge_case({s: verdicts[s][kept] for s in (*pair, twin)}, twin, families[kept]).advice
            case = BY_RATES[sum(rate > rates[2] for rate in rates[:2])]
            yield Case((table.stem, twin, *pair), rates, case, stated, float(better[0]), gains)


def _r(values: Array, truth: Array, filled: Array) -> Array:
    """Pearson's r over the filled cells of each resample; NaN if constant."""
    weights = filled / filled.sum(axis=1, keepdims=True)
    one, other = (x - (weights * x).sum(axis=1, keepdims=True) for x in (values, truth))
    squares = (weights * one**2).sum(axis=1) * (weights * other**2).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray((weights * one * other).sum(axis=1) / np.sqrt(squares))


def main() -> None:
    """Write the cases, and print the page's table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/data/when_product_pays.csv"))
    arguments = parser.parse_args()
    tables = [*(TABLES / f"{name}.parquet" for name in NETWORKS), *filter(Path.exists, map(third_table, NETWORKS))]
    cases = [case for table in tables for case in cases_of(table)]
    with arguments.out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        heads = ["campaign", "twin", "sibling", "other sibling", "sibling's rate", "other's rate", "twin's rate"]
        of_gains = [f"{operator}, {end}" for operator in OPERATORS for end in ("gain", "low", "high")]
        writer.writerow([*heads, "case", "stated", "r of the better", *of_gains])
        for one in cases:
            numbers = [one.better, *(value for operator in OPERATORS for value in one.gains[operator])]
            campaign, *simulators = one.key
            base = campaign.removesuffix(f"_{THIRD}")
            head = [campaign.replace(base, title_of(base)), *simulators, *(f"{rate:.4f}" for rate in one.rates)]
            writer.writerow([*head, one.case, one.stated, *(f"{value:z.4f}" for value in numbers)])
    for case in reversed(BY_RATES):
        of_case = [one for one in cases if one.case == case]
        right = sum(one.stated == case for one in of_case)
        wrong = sum(one.stated not in (case, "drive") for one in of_case)
        row = [case, str(len(of_case)), f"{right}, {wrong}"]
        for operator in OPERATORS:
            gains = np.array([one.gains[operator] for one in of_case])
            above, below = int((gains[:, 1] > EXACT).sum()), int((gains[:, 2] < -EXACT).sum())
            row.append(f"{gains[:, 0].mean():+.3f}; {above}, {below}")
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
