"""Compares the objectives of a search of roads and conditions: the same budget, several seeds, effect sizes.

`python -m benchmarks.conditions.objectives --out objectives` runs one campaign for each objective and seed with the
engine `local`, each in its own folder; stopped, the same command goes on with the test at which it was. Every test is
driven on every sibling, whatever the objective, so that the budgets are the same. It prints and writes, per objective:
distinct failing cells, tests that fail on all siblings, and tests on which the siblings differ, over tests that are
valid on all of them. Effect sizes are Vargha and Delaney's A12 over the paper's objective: the probability that a
campaign of one finds more than a campaign of the other, ties counted half (0.56 small, 0.64 medium, 0.71 large: J.
Educ. Behav. Stat. 25(2), 2000), with the p-value of Mann and Whitney, which is at least 2/252 for five seeds each.

Fixed before the first campaign: siblings, conditions and their ranges, budget, axes, numbers compared. Other budgets
(`--population`, `--iterations`) only try whether it works. Its 15 campaigns are 6,750 drives and as many gates: 13 to
16 minutes each with `dave2@openvino-bf16` on two cores.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.stats import PermutationMethod, mannwhitneyu

from ds_orchestrator.campaign.campaign_data import CampaignData, read_campaign
from ds_orchestrator.campaign.config import CampaignConfig, parse_config
from ds_orchestrator.campaign.folder import open_store
from ds_orchestrator.cli.output import duration, say
from ds_orchestrator.evaluation.table import Column, Table, write_tables
from ds_orchestrator.run import run_campaign
from ds_orchestrator.search.objectives import OBJECTIVES

SEEDS = 5
BUDGET = (10, 40)
"""Initial and further tests of each search; chosen: a third of the paper's 150, for what 15 campaigns cost."""
PAPER = next(iter(OBJECTIVES))
CONDITIONS = {"line_contrast": {"low": 0.05, "high": 1.0}, "visibility": {"low": 20.0, "high": 200.0}}
"""What is searched beside roads; chosen: what the visibility of a lane depends on most directly."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """What one campaign found.

    Attributes:
        failing_cells: cells with a test that fails on some sibling.
        fail_everywhere: tests that fail on all siblings.
        differ: tests that fail on some siblings and not on others.
        tests: tests that are valid on all siblings.
    """

    failing_cells: int
    fail_everywhere: int
    differ: int
    tests: int


def config_of(
    objective: str, seed: int, driver: str, siblings: Sequence[str], workers: int, budget: tuple[int, int]
) -> CampaignConfig:
    """Configuration of one campaign; 50 tests with the default budget, each on every sibling, from every sibling."""
    raw = {
        "siblings": list(siblings), "twin": "none", "driver": driver, "engine": "local", "workers": workers,
        "seed": seed, "record": "none",
        "search": {
            "population": budget[0], "iterations": budget[1], "runs": 1, "conditions": CONDITIONS,
            "objective": objective,
        },
    }  # fmt: skip
    return parse_config(raw, "benchmarks.conditions.objectives")


def found_in(data: CampaignData) -> Found:
    """Count what a campaign found, over tests with a verdict on every sibling."""
    failed: dict[str, list[bool]] = {}
    for execution in data.verdicts:
        failed.setdefault(execution.test_id, []).append(execution.outcome.is_failure)
    whole = {test_id: of for test_id, of in failed.items() if len(of) == len(data.config.siblings)}
    return Found(
        failing_cells=len({data.cells[test_id] for test_id, of in whole.items() if any(of) and test_id in data.cells}),
        fail_everywhere=sum(all(of) for of in whole.values()),
        differ=sum(any(of) and not all(of) for of in whole.values()),
        tests=len(whole),
    )


def a12(first: Sequence[float], second: Sequence[float]) -> tuple[float, float]:
    """Vargha and Delaney's A12 of the first over the second, and the two-sided p-value of Mann and Whitney."""
    every = PermutationMethod(n_resamples=9999, rng=np.random.default_rng(0))  # all 252 of five and five, ties included
    result = mannwhitneyu(first, second, alternative="two-sided", method=every)
    return float(result.statistic) / (len(first) * len(second)), float(result.pvalue)


def table_of(found: Mapping[str, Sequence[Found]]) -> Table:
    """Medians and effect sizes, one row for each objective and number."""
    rows = []
    for objective, campaigns in found.items():
        for name in ("failing_cells", "fail_everywhere", "differ", "tests"):
            values = [float(getattr(one, name)) for one in campaigns]
            against = [float(getattr(one, name)) for one in found[PAPER]]
            # The first seed is shown as well; with one value each there is nothing to compare.
            effect, p = (None, None) if objective == PAPER or len(values) < 2 else a12(values, against)
            spread = (min(values), max(values))
            rows.append((objective, name.replace("_", " "), len(values), float(np.median(values)), spread, effect, p))
    columns = [
        Column("objective"), Column("number"), Column("seeds", "count"), Column("median", "number"),
        Column("range", "number"), Column(f"A12 over {PAPER}", "number"), Column("p", "p"),
    ]  # fmt: skip
    return Table(name="objectives", title="What searches with several objectives find", columns=columns, rows=rows)


def main() -> None:
    """Run what is missing, then print and write the comparison of what there is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the campaigns; resumed if they are there")
    parser.add_argument("--driver", default="dave2")
    parser.add_argument("--siblings", default="bullet,softbody,panda")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--population", type=int, default=BUDGET[0], help="initial tests of a search")
    parser.add_argument("--iterations", type=int, default=BUDGET[1], help="further tests of a search")
    arguments = parser.parse_args()
    budget = (arguments.population, arguments.iterations)
    siblings = arguments.siblings.split(",")
    found: dict[str, list[Found]] = {}
    done, total = 0, arguments.seeds * len(OBJECTIVES)
    took: list[float] = []
    for seed in range(1, arguments.seeds + 1):  # all objectives of a seed first: a stopped run compares whole seeds
        for objective in OBJECTIVES:
            config = config_of(objective, seed, arguments.driver, siblings, arguments.workers, budget)
            folder = arguments.out / f"{objective}-{seed}"
            known, began = (folder / "report.html").exists(), time.monotonic()
            run_campaign(config, folder, say=lambda line: print(line, flush=True))
            with closing(open_store(folder)) as store:
                found.setdefault(objective, []).append(found_in(read_campaign(store)))
            done += 1
            if not known:
                took.append(time.monotonic() - began)
            left = duration(sum(took) / len(took) * (total - done)) if took else "unknown time"
            say(f"{done}/{total} {objective}, seed {seed}: {found[objective][-1]}; {left} left")
        table = table_of(found)
        table.show(Console())
        write_tables([table], arguments.out)
        document = {objective: [asdict(one) for one in campaigns] for objective, campaigns in found.items()}
        (arguments.out / "objectives.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
